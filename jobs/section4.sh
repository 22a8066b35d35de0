#!/usr/bin/env bash
# One case on a cluster: the paper's recurring scheme, ten cycles, 2.7 million cells at 3 um.
#
#   sbatch jobs/section4.sh                                     from the repository
#   CELL_SIZE="2 um" OUT=/scratch/me/section4-2um sbatch --nodes=4 jobs/section4.sh
#   DRY_RUN=1 bash jobs/section4.sh                             only print the command
#
# How many ranks: 50 000 to 200 000 cells for each; "f2s check section4" prints cells and memory per rank.
# If the time is not enough, or a node fails, the last checkpoint stays; go on with  OUT=... sbatch jobs/chain.sh
# (SLURM must not start this job again by itself: f2s run refuses the folder that is in use.)
#
# Variables: SCENE, CELL_SIZE, OUT, and those of jobs/common.sh. Arguments go to f2s run.
#SBATCH --job-name=f2s-section4
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=32
#SBATCH --cpus-per-task=1
#SBATCH --time=12:00:00
#SBATCH --signal=B:USR1@600
#SBATCH --no-requeue
#SBATCH --open-mode=append
#SBATCH --output=%x-%j.log
set -euo pipefail

F2S_ROOT=${F2S_ROOT:-${SLURM_SUBMIT_DIR:-$(cd "$(dirname "$0")/.." && pwd)}}
. "$F2S_ROOT/jobs/common.sh"
SCENE=${SCENE:-section4}
CELL_SIZE=${CELL_SIZE:-3 um}
OUT=${OUT:-runs/section4-${SLURM_JOB_ID:-local}}

prepare_node
provenance "$OUT.jobs.txt"
code=0
run_ranks "$NTASKS" f2s run "$SCENE" --out "$OUT" --set "domain.cell_size=$CELL_SIZE" "$@" || code=$?
if [ $code -eq 75 ]; then
    echo "not finished in this job; go on with:  OUT=$OUT sbatch jobs/chain.sh"
fi
exit $code
