"""MERL: DDPG with a multimodal representation (Algorithm 1 of the paper).

The procedures are in `merl.agents.ddpg`, the values are the defaults of `merl.agents.config`, and
`merl.agents.networks` builds the networks:

    Algorithm 1                           in `Networks` and `DDPG`
    f_xi, image encoder                   encoders.by_key["image"]: four convolutions
    g_zeta, proprioception encoder        encoders.by_key["proprio"]: identity, or an MLP
    h_psi_critic, h_psi_actor             critic_fusion, actor_fusion: Linear, LayerNorm, tanh
    pi_theta, Q_phi1 and Q_phi2           actor, critic: MLPs with LayerNorm and ReLU
    Q_phi1-bar, Q_phi2-bar                critic_target: a copy of the Q-heads alone
    UPDATECRITIC, UPDATEACTOR             DDPG.update_critic, DDPG.update_actor

docs/explanation/paper.md lists the choices made where the paper is silent or contradicts itself.
"""

from __future__ import annotations

from dataclasses import dataclass

from merl.agents.config import AgentConfig


@dataclass(frozen=True)
class MERLConfig(AgentConfig):
    """MERL: camera and joints, fused separately for actor and critic; values of Table 1."""
