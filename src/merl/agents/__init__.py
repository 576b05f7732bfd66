"""The agents: one learner (`ddpg`), and each agent a short declaration of what it sees (`merl`)."""
