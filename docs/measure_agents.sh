#!/usr/bin/env bash
# Learning curves of agents on the three tasks, one core a run; by default the state-based ones, the
# two tasks with a box in their easier form (docs/tasks.md, "All three are learnt"). Their numbers go
# to docs/data/agents. What stands there for as many steps is not run again; a run that was stopped
# goes on. Two at once on two cores:
#     docs/measure_agents.sh 0 & docs/measure_agents.sh 1 & wait
# PRESET (state), STEPS (100000), AGENTS, TASKS and SETTING (matched or published) may be set:
#     PRESET=laptop TASKS=reach_duplo AGENTS="merl drqv2 proprio" STEPS=40000 docs/measure_agents.sh
set -euo pipefail
cd "$(dirname "$0")/.."
preset=${PRESET:-state} steps=${STEPS:-100000} setting=${SETTING:-matched}
[ $# -gt 0 ] || set -- 0
easier="--start around holding --reward both --floor smooth"
mkdir -p docs/data/agents
for seed in "$@"; do
  for task in ${TASKS:-reach_duplo move_box lift_box}; do
    for agent in ${AGENTS:-ddpg sac merl_state}; do
      name=$task-$agent-$preset-$setting-s$seed
      run=runs/agents/$name data=docs/data/agents/$name
      if [ -e "$data-evaluation.json" ] && [ "$(tail -n 1 "$data.csv" | cut -d, -f1)" -ge "$steps" ]; then
        continue
      fi
      form=
      if [ "$task" != reach_duplo ]; then form=$easier; fi
      case $agent-$setting in
        sac-* | *-published) ;; # their noise is their own
        drqv2-*) form="$form --agent.noise-steps $((steps / 2))" ;;
        *) if [ -n "$form" ]; then form="$form --agent.noise-std 0.1"; fi ;;
      esac
      # shellcheck disable=SC2086 # the form is a list of flags
      merl train "$task" --agent "$agent" --setting "$setting" --preset "$preset" --steps "$steps" \
        --seed "$seed" --threads 1 --eval.video none $form --run-dir "$run" --resume
      cp "$run/metrics.csv" "$data.csv"
      merl evaluate "$run" --episodes 50 --json "$data-evaluation.json"
    done
  done
done
