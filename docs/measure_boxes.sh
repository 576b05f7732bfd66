#!/usr/bin/env bash
# MERL from camera + joints on the two tasks with a box, as the paper starts them (hand above, rough
# floor): preset laptop with the paper's six layers, reward `staged`, a million steps, one core each.
# Begins both runs, or continues them; stop them with SIGTERM, which saves:
#     docs/measure_boxes.sh; kill -TERM $(cat runs/boxes/*.pid)
# The rows so far go to docs/data/boxes with
#     docs/measure_boxes.sh rows
set -euo pipefail
cd "$(dirname "$0")/.."
seed=${SEED:-0} reward=${REWARD:-staged} steps=${STEPS:-1000000}
mkdir -p runs/boxes docs/data/boxes
for task in ${TASKS:-move_box lift_box}; do
  name=$task-merl-laptop6-$reward-s$seed
  run=runs/boxes/$name
  if [ "${1:-}" = rows ]; then
    cp "$run/metrics.csv" "docs/data/boxes/$name.csv"
    continue
  fi
  nohup nice -n 19 merl train "$task" --preset laptop --agent.head-layers 6 --reward "$reward" \
    --steps "$steps" --seed "$seed" --eval.every 20000 --eval.video none --replay.compress \
    --threads 1 --agent.precision bf16 --run-dir "$run" --resume >>"$run.log" 2>&1 &
  echo $! >"$run.pid"
done
