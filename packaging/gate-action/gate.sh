#!/usr/bin/env bash
# Did a change help? Builds and runs two revisions in turns, and ends with the gate's exit code: 0 passed, 3 runs failed,
# 4 regressed, 5 undecided. Usage, in the repository: gate.sh [BASE [HEAD]]. BASE is HEAD~1 by default, HEAD the working tree.
# Environment: GATE (gate.toml), and, for the first time, TRACKER, BUILD and SEQUENCES (one a line) to write it;
# SUMMARY (a file to append the summary to), RESULTS (results/gate), PYTHON (python3).
set -euo pipefail
python=${PYTHON:-python3}
gate=${GATE:-gate.toml}
base=${1:-HEAD~1}
head=${2:-}

if [ ! -f "$gate" ]; then
  options=(--gate "$gate" --build "${BUILD:-}")
  if [ -n "${TRACKER:-}" ]; then options+=(--tracker "$TRACKER"); fi
  while IFS= read -r sequence; do
    if [ -n "$sequence" ]; then options+=(--sequence "$sequence"); fi
  done <<<"${SEQUENCES:-}"
  "$python" -m dynslam_bench gate init "${options[@]}"
fi

options=(--gate "$gate" --results "${RESULTS:-results/gate}")
if [ -n "${SUMMARY:-}" ]; then options+=(--summary "$SUMMARY"); fi
exec "$python" -m dynslam_bench gate compare "$base" ${head:+"$head"} "${options[@]}"
