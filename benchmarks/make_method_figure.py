"""Draw the data flow of MERL with its shapes: python benchmarks/make_method_figure.py.

The shapes are those of preset `paper` on `reach_duplo`, read from its config and its networks.
Writes docs/images/method.svg. All text stands in filled boxes, so that the figure is readable on a
light and on a dark page.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from gymnasium import spaces

from merl.agents import make_agent
from merl.experiments.presets import compose

OUTPUT = Path(__file__).resolve().parent.parent / "docs/images/method.svg"
WIDTH, HEIGHT = 1000, 460
DATA, CRITIC, ACTOR, LINE = "#586271", "#1c67a8", "#a9500a", "#8b95a1"
PROPRIO, ACTIONS = 24, 9


class Box(NamedTuple):
    """A rectangle with lines of text; the first line is bold."""

    x: int
    y: int
    width: int
    height: int
    colour: str
    lines: tuple[str, ...]

    @property
    def left(self) -> tuple[int, int]:
        """The middle of the left edge."""
        return self.x, self.y + self.height // 2

    @property
    def right(self) -> tuple[int, int]:
        """The middle of the right edge."""
        return self.x + self.width, self.y + self.height // 2

    @property
    def top(self) -> tuple[int, int]:
        """The middle of the upper edge."""
        return self.x + self.width // 2, self.y

    @property
    def bottom(self) -> tuple[int, int]:
        """The middle of the lower edge."""
        return self.x + self.width // 2, self.y + self.height

    def svg(self) -> str:
        """Return the rectangle and its text."""
        middle, first = self.x + self.width // 2, self.y + self.height // 2 - 8 * len(self.lines)
        text = [
            f'<text x="{middle}" y="{first + 12 + 16 * i}" font-weight="{400 if i else 700}">'
            f"{line}</text>"
            for i, line in enumerate(self.lines)
        ]
        shape = f'<rect x="{self.x}" y="{self.y}" width="{self.width}" height="{self.height}"'
        return "\n".join([f'{shape} rx="6" fill="{self.colour}"/>', *text])


def arrow(*points: tuple[int, int], dashed: bool = False) -> str:
    """Return a line through the points that ends in an arrow head."""
    path = " ".join(f"{x},{y}" for x, y in points)
    dashes = ' stroke-dasharray="5 4"' if dashed else ""
    return f'<polyline points="{path}" marker-end="url(#head)"{dashes}/>'


def shapes() -> dict[str, str]:
    """Return the numbers of the figure by name."""
    config = compose("paper", "reach_duplo")
    size, stack = config.env.image_size, config.replay.frame_stack
    space = spaces.Dict(
        {
            "image": spaces.Box(0, 255, (size, size, 3), np.uint8),
            "proprio": spaces.Box(-np.inf, np.inf, (PROPRIO,), np.float32),
        }
    )
    networks = make_agent(
        config.agent,
        space,
        spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32),
        frame_stack=stack,
        seed=0,
        device=torch.device("cpu"),
    ).networks
    latent = config.agent.latent_dim
    return {
        "stack": f"{stack} x {size} x {size} x 3",
        "pad": str(config.agent.shift_pad),
        "convolutions": str(len(config.agent.conv_strides)),
        "image": f"{networks.encoders.features['image']:,}",
        "proprio": str(networks.encoders.features["proprio"]),
        "fused": f"{latent // 2} + {latent // 2} = {latent}",
        "critic": f"{latent} + {ACTIONS}",
        "latent": str(latent),
        "heads": f"{config.agent.head_layers} layers of {config.agent.hidden_dim:,}",
        "batch": str(config.replay.batch_size),
        "steps": f"{config.replay.n_step}-step return",
        "tau": str(config.agent.tau),
        "noise": str(config.agent.noise_std),
        "capacity": f"{config.replay.capacity:,}",
    }


def figure(n: dict[str, str]) -> str:
    """Return the figure as SVG."""
    image = Box(10, 60, 150, 60, DATA, ("camera", n["stack"], "uint8, per sample"))
    joints = Box(10, 190, 150, 60, DATA, ("joints", n["proprio"], "float32, per sample"))
    moved = Box(
        190, 60, 130, 60, DATA, ("random shift", f"by up to {n['pad']} pixels", "(updates)")
    )
    encoder = Box(350, 60, 150, 60, CRITIC, (f"{n['convolutions']} convolutions", n["image"]))
    identity = Box(350, 190, 150, 60, DATA, ("identity", n["proprio"]))
    fusion = ("Linear, LayerNorm,", "tanh per modality", n["fused"])
    of_critic = Box(590, 45, 170, 90, CRITIC, ("fusion of the critic", *fusion))
    of_actor = Box(590, 175, 170, 90, ACTOR, ("fusion of the actor", *fusion))
    critic = Box(810, 45, 180, 90, CRITIC, ("Q1, Q2", n["critic"], n["heads"], "1 value each"))
    actor = Box(810, 175, 180, 90, ACTOR, ("actor", n["latent"], n["heads"], f"{ACTIONS} actions"))
    stop = Box(506, 236, 78, 40, DATA, ("stop", "gradient"))
    target = Box(810, 5, 180, 28, DATA, (f"targets: average, {n['tau']}",))
    env = Box(810, 330, 180, 60, DATA, ("environment", "0.04 s per step"))
    noise = Box(590, 330, 170, 60, DATA, ("collector", f"adds noise {n['noise']}", "stacks frames"))
    replay = Box(350, 330, 150, 60, DATA, ("replay buffer", "single frames", n["capacity"]))
    batch = Box(
        10, 330, 310, 60, DATA, (f"batch of {n['batch']}", f"stacks of frames, {n['steps']}")
    )
    legend = [
        Box(10, 420, 290, 32, CRITIC, ("trained by the critic's loss L",)),
        Box(320, 420, 290, 32, ACTOR, ("trained by the actor's loss J",)),
        Box(630, 420, 360, 32, DATA, ("no weights, or not trained by a loss",)),
    ]
    (ex, ey), (ix, iy) = encoder.right, identity.right
    arrows = [
        arrow(image.right, moved.left),
        arrow(moved.right, encoder.left),
        arrow(joints.right, identity.left),
        arrow((ex, ey), (of_critic.x, ey)),
        arrow((ix, iy - 15), (545, iy - 15), (545, 115), (of_critic.x, 115)),
        arrow((ex, ey + 20), (528, ey + 20), (528, 200), (of_actor.x, 200), dashed=True),
        arrow((ix, iy + 5), (of_actor.x, iy + 5), dashed=True),
        arrow(of_critic.right, critic.left),
        arrow(of_actor.right, actor.left),
        arrow(actor.top, critic.bottom),
        arrow(critic.top, target.bottom),
        arrow((920, 265), (920, 295), (675, 295), noise.top),
        arrow((noise.right[0], 350), (env.x, 350)),
        arrow((env.x, 372), (noise.right[0], 372)),
        arrow(noise.left, replay.right),
        arrow(replay.left, batch.right),
        arrow((85, 330), joints.bottom),
        arrow((175, 330), (175, 150), (85, 150), image.bottom),
    ]
    boxes = [image, joints, moved, encoder, identity, of_critic, of_actor, critic, actor, stop]
    boxes += [target, env, noise, replay, batch, *legend]
    head = (
        '<marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
        f'orient="auto"><path d="M0,0 L10,5 L0,10 z" fill="{LINE}"/></marker>'
    )
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
            'font-family="DejaVu Sans, Arial, sans-serif" font-size="13">',
            "<title>Data flow of MERL with the shapes of preset paper</title>",
            f"<defs>{head}</defs>",
            f'<g fill="none" stroke="{LINE}" stroke-width="2">',
            *arrows,
            "</g>",
            '<g fill="#fff" text-anchor="middle">',
            *(box.svg() for box in boxes),
            "</g>",
            "</svg>\n",
        ]
    )


if __name__ == "__main__":
    OUTPUT.write_text(figure(shapes()))
    print(OUTPUT)
