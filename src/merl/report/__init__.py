"""What a run has to show: its curves, their uncertainty, and the pictures made of them.

Everything here works from a run's folder alone and needs neither torch nor MuJoCo.
"""

from merl.core.resources import load_matplotlib

load_matplotlib()
