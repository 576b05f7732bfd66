"""MERL: DDPG, given the right multimodal representation. Read it beside Algorithm 1 of the paper.

The procedures are the learner's (`merl.agents.ddpg`), the values are those of
`merl.agents.config`, whose defaults are MERL's, and `merl.agents.networks` builds from them:

    Algorithm 1                           its place in `Networks`
    f_xi, image encoder                   encoders.images[key]: four convolutions, random shift
    g_zeta, proprioception encoder        encoders.vectors[key]: identity, or an MLP
    h_psi_critic, h_psi_actor             critic_fusion, actor_fusion: Linear, LayerNorm, tanh
    pi_theta, Q_phi1 and Q_phi2           actor, critic: MLPs with LayerNorm and ReLU
    Q_phi1-bar, Q_phi2-bar                critic_target: the Q-heads alone are averaged
    UPDATECRITIC, UPDATEACTOR             DDPG.update_critic, DDPG.update_actor

Where the paper is silent or contradicts itself, `docs/paper.md` says what was chosen.
"""

from __future__ import annotations

from dataclasses import dataclass

from merl.agents.config import AgentConfig


@dataclass(frozen=True)
class MERLConfig(AgentConfig):
    """MERL: camera and joints, fused separately for actor and critic; Table 1's values."""
