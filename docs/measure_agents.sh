#!/usr/bin/env bash
# Learning curves of agents on a task, one core a run; by default the state-based ones on reach_duplo.
# Their numbers go to docs/data/agents. What stands there for as many steps is not run again; a run
# that was stopped goes on. Two at once on two cores:
#     docs/measure_agents.sh 0 & docs/measure_agents.sh 1 & wait
# PRESET (state), STEPS (100000), AGENTS, TASKS and SETTING (matched or published) may be set:
#     PRESET=laptop AGENTS="merl drqv2 proprio" STEPS=40000 docs/measure_agents.sh
set -euo pipefail
cd "$(dirname "$0")/.."
preset=${PRESET:-state} steps=${STEPS:-100000} setting=${SETTING:-matched}
[ $# -gt 0 ] || set -- 0
mkdir -p docs/data/agents
for seed in "$@"; do
  for task in ${TASKS:-reach_duplo}; do
    for agent in ${AGENTS:-ddpg sac merl_state}; do
      name=$task-$agent-$preset-$setting-s$seed
      run=runs/agents/$name data=docs/data/agents/$name
      if [ -e "$data-evaluation.json" ] && [ "$(tail -n 1 "$data.csv" | cut -d, -f1)" -ge "$steps" ]; then
        continue
      fi
      noise=
      case $agent-$setting in
        *-published) ;; # their noise is their own
        drqv2-*) noise="--agent.noise-steps $((steps / 2))" ;;
      esac
      # shellcheck disable=SC2086 # a list of flags
      merl train "$task" --agent "$agent" --setting "$setting" --preset "$preset" --steps "$steps" \
        --seed "$seed" --threads 1 --eval.video none $noise --run-dir "$run" --resume
      cp "$run/metrics.csv" "$data.csv"
      merl evaluate "$run" --episodes 50 --json "$data-evaluation.json"
    done
  done
done
