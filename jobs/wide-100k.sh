#!/usr/bin/env bash
# A hundred thousand particles on 2.24 x 2.24 mm: 5.9 million cells of 8 um, five cycles, in as many jobs as it takes.
#
#   sbatch jobs/wide-100k.sh                              128 ranks, into runs/wide-100k
#   OUT=/scratch/me/wide sbatch --nodes=4 jobs/wide-100k.sh --set domain.cell_size="4 um"
#   DRY_RUN=1 bash jobs/wide-100k.sh                      only print the command
#
# How many ranks: "f2s plan wide-100k --ranks 32,64,128,256" predicts time, memory and efficiency.
# It is jobs/chain.sh with another scene: a checkpoint before the time limit, then the same job again.
#
# Variables: OUT, and those of jobs/common.sh. Arguments go to f2s run, at the start only.
#SBATCH --job-name=f2s-wide
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=64
#SBATCH --cpus-per-task=1
#SBATCH --time=06:00:00
#SBATCH --signal=B:USR1@600
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=%x-%j.log
set -euo pipefail

export SCENE=wide-100k OUT=${OUT:-runs/wide-100k} JOB_SCRIPT=jobs/wide-100k.sh
# exec keeps the process that SLURM signals
exec bash "${F2S_ROOT:-${SLURM_SUBMIT_DIR:-$(cd "$(dirname "$0")/.." && pwd)}}/jobs/chain.sh" "$@"
