#!/usr/bin/env bash
# A run that is longer than a job may be: starts it, and goes on from the newest checkpoint in job after job
# until it is complete.
#
#   OUT=runs/section4 sbatch jobs/chain.sh --set domain.cell_size="2 um"     arguments only count at the start
#   OUT=runs/section4 CYCLES=14 sbatch jobs/chain.sh                         more cycles, also onto a complete run
#   SCENE=$PWD/mine.toml OUT=runs/mine sbatch jobs/chain.sh                  a scene of your own
#   OUT=runs/section4 bash jobs/chain.sh                                     on a workstation: one after another
#   DRY_RUN=1 bash jobs/chain.sh                                             only print the command
#
# Ten minutes before the time limit SLURM signals, f2s writes a checkpoint and returns 75, and this job puts
# itself in the queue again. A node that fails is the same case: SLURM requeues, f2s resumes; before the first
# checkpoint it starts anew, and what was lost is kept beside as OUT-lost-1, -2, ... Another number of ranks is
# possible at any link. The chain ends when the run is complete, at any other error, when a link has gained no
# checkpoint, or after "touch $OUT/STOP".
#
# Variables: SCENE, OUT, CYCLES, and those of jobs/common.sh.
#SBATCH --job-name=f2s-chain
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=32
#SBATCH --cpus-per-task=1
#SBATCH --time=12:00:00
#SBATCH --signal=B:USR1@600
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=%x-%j.log
set -euo pipefail

F2S_ROOT=${F2S_ROOT:-${SLURM_SUBMIT_DIR:-$(cd "$(dirname "$0")/.." && pwd)}}
. "$F2S_ROOT/jobs/common.sh"
SCENE=${SCENE:-section4}
OUT=${OUT:-runs/$(basename "$SCENE" .toml)-chain}
NOT_FINISHED=75

# (by the time of writing: names do not tell once one was damaged and written anew)
newest_checkpoint() {
    [ ! -d "$OUT/checkpoints" ] || find "$OUT/checkpoints" -name '*.json' -printf '%T@ %p\n' | sort -n | tail -n 1
}

# busy: is another run at work in OUT? (f2s holds a lock there, where the file system has locks.)
busy() {
    [ -e "$OUT/.lock" ] && command -v flock >/dev/null || return 1
    local code=0
    flock -n -E 9 "$OUT/.lock" true 2>/dev/null || code=$?
    [ $code -eq 9 ]
}

# lost: is OUT the folder of a run that ended before its first checkpoint? (A complete run may have been told to
# write none.)
lost() {
    [ -d "$OUT/checkpoints" ] && [ -z "$(newest_checkpoint)" ] &&
        ! grep -qs '"status": "complete"' "$OUT/summary.json"
}

# set_aside: give the folder OUT another name, so that the run can start anew.
set_aside() {
    local number=1
    while [ -e "$OUT-lost-$number" ]; do
        number=$((number + 1))
    done
    echo "$OUT has no checkpoint: starting anew, what is there becomes $OUT-lost-$number"
    [ "$DRY_RUN" = 1 ] || mv "$OUT" "$OUT-lost-$number"
}

# link ARGUMENTS...: one job's worth of the run. (f2s itself refuses a folder that is none of its own.)
link() {
    if busy; then
        echo "$OUT: another run is at work in it; wait for its end, or choose another folder with OUT"
        return 2
    fi
    if lost; then
        set_aside
    elif [ -d "$OUT/checkpoints" ]; then
        run_ranks "$NTASKS" f2s resume "$OUT" ${CYCLES:+--set "cycles.count=$CYCLES"}
        return
    fi
    run_ranks "$NTASKS" f2s run "$SCENE" --out "$OUT" "$@" ${CYCLES:+--set "cycles.count=$CYCLES"}
}

# back_to_the_queue: this very job again; where requeueing is switched off, a new job of the same script, with what SLURM
# tells of how this one was asked for.
back_to_the_queue() {
    scontrol requeue "$SLURM_JOB_ID" && return
    local again=(--ntasks="$NTASKS")
    [ -z "${SLURM_JOB_NUM_NODES:-}" ] || again+=(--nodes="$SLURM_JOB_NUM_NODES")
    [ -z "${SLURM_NTASKS_PER_NODE:-}" ] || again+=(--ntasks-per-node="$SLURM_NTASKS_PER_NODE")
    [ -z "${SLURM_JOB_PARTITION:-}" ] || again+=(--partition="$SLURM_JOB_PARTITION")
    [ -z "${SLURM_JOB_ACCOUNT:-}" ] || again+=(--account="$SLURM_JOB_ACCOUNT")
    [ -z "${SLURM_JOB_QOS:-}" ] || again+=(--qos="$SLURM_JOB_QOS")
    # (in seconds since 1970, from SLURM 22 on; in minutes)
    [ -z "${SLURM_JOB_START_TIME:-}" ] || [ -z "${SLURM_JOB_END_TIME:-}" ] ||
        again+=(--time="$(((SLURM_JOB_END_TIME - SLURM_JOB_START_TIME) / 60))")
    OUT=$OUT SCENE=$SCENE sbatch "${again[@]}" "$F2S_ROOT/${JOB_SCRIPT:-jobs/chain.sh}"
}

prepare_node
provenance "$OUT.jobs.txt"
while true; do
    before=$(newest_checkpoint)
    code=0
    link "$@" || code=$?
    if [ $code -ne $NOT_FINISHED ]; then
        [ $code -eq 0 ] || echo "the chain ends: f2s returned $code"
        exit $code
    fi
    if [ "$ASKED_TO_END" = yes ]; then
        echo "the chain ends: it was asked to; start it again to go on"
        exit $NOT_FINISHED
    fi
    if [ -e "$OUT/STOP" ]; then
        echo "the chain ends: $OUT/STOP told it to; remove that file and start it again to go on"
        exit $NOT_FINISHED
    fi
    if [ "$(newest_checkpoint)" = "$before" ]; then
        echo "the chain ends: this link gained no checkpoint; give it more time or more ranks"
        exit $NOT_FINISHED
    fi
    if [ -n "${SLURM_JOB_ID:-}" ]; then
        echo "not finished: back to the queue"
        back_to_the_queue
        exit 0
    fi
done
