"""Make the README's moving picture of a trained arm: python benchmarks/make_arm_picture.py RUN.

Plays the first seconds of the first evaluation episodes of a run, without exploration noise and
without a choice among episodes, and writes docs/images/trained_arm.webp.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

import merl
from merl.evaluation.evaluation import EVALUATION_SEED
from merl.evaluation.policy import Policy

OUTPUT = Path(__file__).resolve().parent.parent / "docs/images/trained_arm.webp"
SIZE = 320  # pixels
RENDERED = 960  # pixels; reduced to SIZE, which smooths the edges
EVERY = 2  # environment steps between two frames


def main() -> None:
    """Record the episodes and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=5.0, help="shown of each episode")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    policy = merl.load_policy(options.run)
    frames = record(policy, options.episodes, options.seconds)
    rate = policy.make_env().metadata["render_fps"]
    frames[0].save(
        options.output,
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 * EVERY / rate),
        loop=0,
        quality=60,
        method=6,
    )
    print(f"{options.output}: {len(frames)} frames, {options.output.stat().st_size:,} bytes")


def record(policy: Policy, episodes: int, seconds: float) -> list[Image.Image]:
    """Return the frames of the first `seconds` of each episode."""
    env = policy.make_env(render_mode="rgb_array", render_size=RENDERED)
    steps = round(seconds * env.metadata["render_fps"])
    frames = []
    for episode in range(episodes):
        observation, _ = env.reset(seed=EVALUATION_SEED + episode)
        policy.reset()
        for step in range(steps):
            if step % EVERY == 0:
                image = Image.fromarray(env.render())  # type: ignore[arg-type]
                frames.append(image.resize((SIZE, SIZE), Image.Resampling.BOX))
            observation, _, _, _, info = env.step(policy(observation))
        print(f"episode {episode}: distance {100 * info['distance']:.1f} cm after {seconds:g} s")
    env.close()
    return frames


if __name__ == "__main__":
    main()
