#!/usr/bin/env bash
# Learning curves of agents on the three tasks, one core a run; by default the state-based ones.
# A run that is done is not run again; one that was stopped goes on. Its numbers are copied to
# docs/data/agents. Two at once on two cores:
#     docs/measure_agents.sh 0 & docs/measure_agents.sh 1 & wait
# PRESET (state), STEPS (100000), AGENTS, TASKS and SETTING (matched or published) may be set:
#     PRESET=laptop STEPS=100000 TASKS=reach_duplo AGENTS="merl drqv2 proprio" docs/measure_agents.sh
set -euo pipefail
cd "$(dirname "$0")/.."
preset=${PRESET:-state} steps=${STEPS:-100000} setting=${SETTING:-matched}
[ $# -gt 0 ] || set -- 0
mkdir -p docs/data/agents
for seed in "$@"; do
  for task in ${TASKS:-reach_duplo move_box lift_box}; do
    for agent in ${AGENTS:-ddpg sac merl_state}; do
      name=$task-$agent-$preset-$setting-s$seed; run=runs/agents/$name
      merl train "$task" --agent "$agent" --setting "$setting" --preset "$preset" --steps "$steps" \
        --seed "$seed" --threads 1 --eval.video none --run-dir "$run" --resume
      cp "$run/metrics.csv" "docs/data/agents/$name.csv"
      merl evaluate "$run" --episodes 50 --json "docs/data/agents/$name-evaluation.json"
    done
  done
done
