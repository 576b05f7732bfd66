#!/usr/bin/env bash
# An hour of preset laptop for each seed, one after the other, and 50 evaluation episodes of each:
# the numbers behind docs/laptop.md. A seed that is done is not run again; one that was stopped goes
# on. Wants the machine to itself.
#     docs/measure_laptop.sh                                   # seeds 0, 1, 2
#     NAME=avx2 ONEDNN_MAX_CPU_ISA=AVX2 docs/measure_laptop.sh 0
set -euo pipefail
cd "$(dirname "$0")/.."
name=laptop${NAME:+-$NAME} minutes=${MINUTES:-60}
[ $# -gt 0 ] || set -- 0 1 2
for seed in "$@"; do
  run=runs/$name-seed$seed
  if [ ! -d "$run" ]; then
    merl train reach_duplo --preset laptop --minutes "$minutes" --seed "$seed" --run-dir "$run"
  else
    spent=$(tail -n 1 "$run/metrics.csv" | cut -d, -f "$(head -n 1 "$run/metrics.csv" | tr , '\n' | grep -n '^time/seconds$' | cut -d: -f1)")
    left=$(python3 -c "print(max(0, $minutes - ${spent:-0} / 60))")
    [ "$left" = 0 ] || merl resume "$run" --minutes "$left"
  fi
  merl evaluate "$run" --episodes 50 --json "docs/data/$name-seed$seed-evaluation.json"
  cp "$run/metrics.csv" "docs/data/$name-seed$seed.csv"
done
