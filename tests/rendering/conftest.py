"""Fixtures for the tests of the renderers."""

import pytest

import merl.tasks  # noqa: F401  (before dm_control, which then does not look for OpenGL)

# isort: split
from dm_control import mujoco as dm_mujoco

EVERY_GEOM = """
<mujoco>
  <visual><map znear="0.05"/></visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.3 0.5 0.7" rgb2="0 0 0" width="64"
      height="64"/>
    <texture name="checks" type="2d" builtin="checker" rgb1="0.2 0.3 0.4" rgb2="0.6 0.7 0.8"
      width="64" height="64"/>
    <material name="checks" texture="checks" texrepeat="2 2" texuniform="true" specular="0"/>
    <material name="shiny" rgba="0.2 0.6 0.3 1" specular="1" shininess="0.8"/>
    <material name="glowing" rgba="0.8 0.2 0.2 1" emission="0.4"/>
    <mesh name="pyramid" vertex="-0.2 -0.2 0  0.2 -0.2 0  0.2 0.2 0  -0.2 0.2 0  0 0 0.4"/>
  </asset>
  <worldbody>
    <light pos="0.5 -0.5 2.5" dir="-0.2 0.2 -1" directional="true" diffuse="0.4 0.4 0.4"/>
    <light pos="-1 -1 2" dir="0.4 0.4 -0.8" cutoff="50" diffuse="0.5 0.5 0.4"/>
    <camera name="view" pos="0 -2.6 1.3" xyaxes="1 0 0 0 0.42 0.9"/>
    <camera name="inside" pos="0 -0.9 0.15" xyaxes="1 0 0 0 0.2 1"/>
    <geom type="plane" size="2 2 0.1" material="checks"/>
    <geom type="box" pos="-0.9 0 0.2" size="0.2 0.15 0.2" euler="0 0 30" rgba="0.7 0.2 0.1 1"/>
    <geom type="sphere" pos="-0.45 0 0.2" size="0.2" material="shiny"/>
    <geom type="capsule" pos="0 0 0.35" size="0.1 0.2" euler="20 0 0" rgba="0.2 0.2 0.7 1"/>
    <geom type="cylinder" pos="0.4 0 0.2" size="0.15 0.2" euler="0 20 0" rgba="0.7 0.7 0.1 1"/>
    <geom type="ellipsoid" pos="0.8 0 0.2" size="0.2 0.1 0.2" material="glowing"/>
    <geom type="mesh" mesh="pyramid" pos="0 0.6 0" rgba="0.5 0.1 0.6 1"/>
    <geom type="box" pos="0 -0.7 0.02" size="1 0.4 0.02" rgba="0.4 0.5 0.4 1"/>
    <geom type="box" pos="0 1 0.5" size="0.3 0.1 0.5" rgba="1 1 1 0"/>
    <geom type="sphere" pos="0 -1 0.5" size="0.3" group="3"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def every_geom():
    physics = dm_mujoco.Physics.from_xml_string(EVERY_GEOM)
    physics.forward()
    yield physics
    physics.free()
