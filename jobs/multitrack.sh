#!/usr/bin/env bash
# The multi-layer deposit of the paper's section 5.3 at its own 2 um: 9.2 million cells, ten cycles, tracers in every
# particle, in as many jobs as it takes.
#
#   sbatch jobs/multitrack.sh                             64 ranks, into runs/multitrack
#   OUT=/scratch/me/multitrack sbatch jobs/multitrack.sh --set 'batches.files=["A.csv", "B.csv"]'
#   DRY_RUN=1 bash jobs/multitrack.sh                     only print the command
#
# Then  f2s analyse runs/multitrack  on any machine, alone: porosity in three ways, flattening from tracers and sections.
# How many ranks: "f2s plan multitrack --ranks 16,32,64,128" predicts time, memory and efficiency.
# It is jobs/chain.sh with another scene: a checkpoint before the time limit, then the same job again.
#
# Variables: OUT, and those of jobs/common.sh. Arguments go to f2s run, at the start only.
#SBATCH --job-name=f2s-multitrack
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=64
#SBATCH --cpus-per-task=1
#SBATCH --time=06:00:00
#SBATCH --signal=B:USR1@600
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=%x-%j.log
set -euo pipefail

export SCENE=multitrack OUT=${OUT:-runs/multitrack} JOB_SCRIPT=jobs/multitrack.sh
# exec keeps the process that SLURM signals
exec bash "${F2S_ROOT:-${SLURM_SUBMIT_DIR:-$(cd "$(dirname "$0")/.." && pwd)}}/jobs/chain.sh" "$@"
