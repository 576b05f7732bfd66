#!/usr/bin/env bash
# The record: preset laptop on reach_duplo for MINUTES (60) with each seed, one after the other, and
# 50 evaluation episodes of each. Needs the machine to itself. A seed that is done is not run again;
# one that was stopped continues. The rows and the episodes go to results/speedrun.
#     benchmarks/speedrun.sh                                     # seeds 0, 1, 2
#     MINUTES=10 benchmarks/speedrun.sh
#     MINUTES=90 NAME=avx2 ONEDNN_MAX_CPU_ISA=AVX2 benchmarks/speedrun.sh 0
set -euo pipefail
cd "$(dirname "$0")/.."
minutes=${MINUTES:-60}
name=laptop${NAME:+-$NAME}-$minutes data=results/speedrun
mkdir -p "$data"
[ $# -gt 0 ] || set -- 0 1 2
for seed in "$@"; do
  run=runs/$name-s$seed
  [ ! -e "$data/$name-s$seed-evaluation.json" ] || continue
  if [ ! -d "$run" ]; then
    merl train reach_duplo --preset laptop --minutes "$minutes" --seed "$seed" --eval.video none --run-dir "$run"
  else
    spent=$(tail -n 1 "$run/metrics.csv" | cut -d, -f "$(head -n 1 "$run/metrics.csv" | tr , '\n' | grep -n '^time/seconds$' | cut -d: -f1)")
    left=$(python3 -c "print(max(0, $minutes - ${spent:-0} / 60))")
    [ "$left" = 0 ] || merl resume "$run" --minutes "$left"
  fi
  cp "$run/metrics.csv" "$data/$name-s$seed.csv"
  merl evaluate "$run" --episodes 50 --json "$data/$name-s$seed-evaluation.json"
done
python benchmarks/speedrun.py
