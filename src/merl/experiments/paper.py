"""The experiments of the paper, a figure each, and those that its argument needs besides.

`merl sweep NAME` runs one of them. Variants of equal name are the same run in all figures.
"""

from __future__ import annotations

from merl.experiments.experiment import Experiment, Variant

MERL = Variant("merl", values={"eval.video": "each"})
"""MERL without a change, filmed at every evaluation for Figure 4."""
DRQV2 = Variant("drqv2", "drqv2")
PROPRIO = Variant("proprio", "proprio")
MERL_STATE = Variant("merl_state", "merl_state")
STATE = (MERL_STATE, Variant("ddpg", "ddpg"), Variant("sac", "sac"))
OCCLUDED = {"env.occluded": True}

EXPERIMENTS = {
    "fig2": Experiment("Figure 2: MERL and other agents", (MERL, DRQV2, *STATE[1:])),
    "fig3a": Experiment(
        "Figure 3a: whose is the fusion",
        (
            MERL,
            Variant("shared", values={"agent.fusion": "shared"}),
            Variant("shared_by_both", values={"agent.fusion": "shared_by_both"}),
        ),
    ),
    "fig3b": Experiment(
        "Figure 3b: length d of the fused representation",
        (
            Variant("d64", values={"agent.latent_dim": 64}),
            MERL,
            Variant("d256", values={"agent.latent_dim": 256}),
        ),
    ),
    "fig3c": Experiment(
        "Figure 3c: LayerNorm in the fusion",
        (MERL, Variant("no_norm", values={"agent.fusion_norm": False})),
    ),
    "fig3d": Experiment(
        "Figure 3d: fixed and scheduled noise",
        (
            MERL,
            Variant("scheduled", values={"agent.noise_std": 1.0, "agent.noise_std_end": 0.1}),
        ),
    ),
    "fig4": Experiment("Figure 4: behaviour during training", (MERL,)),
    "fig5": Experiment(
        "Figure 5: encoder of proprioception",
        (
            MERL,
            *(
                Variant(
                    f"mlp{width}",
                    values={"agent.encoders.proprio": "mlp", "agent.mlp_dim": width},
                )
                for width in (64, 128, 256)
            ),
        ),
    ),
    "senses": Experiment(
        "Which senses MERL needs: camera off, joints off, the simulator's state",
        (
            MERL,
            PROPRIO,
            Variant("camera", values={"agent.modalities": ("image",)}),
            MERL_STATE,
        ),
    ),
    "occluded": Experiment(
        "A disc hides the object from the camera",
        (
            Variant("merl_occluded", values={**OCCLUDED, **MERL.values}),
            Variant("drqv2_occluded", "drqv2", OCCLUDED),
            Variant("proprio_occluded", "proprio", OCCLUDED),
        ),
        tasks=("move_box", "lift_box"),
    ),
    "state": Experiment("Agents that observe the simulator's state", STATE),
}
"""{name: experiment}."""
