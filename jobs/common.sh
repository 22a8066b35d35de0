# Shared by the job scripts of this folder; they read it with "."  Not a job itself.
#
# Variables that every job script understands:
#   F2S_ROOT    the repository; if not set, the folder where sbatch was called, or that of the script
#   F2S_MODULES modules to load, "openmpi petsc hdf5-parallel"; none, if not set
#   LAUNCH      how ranks are started: "mpirun -n" (if not set), or for example "srun --mpi=pmix -n"
#   DRY_RUN=1   print the commands instead of running them

# JOB_SCRIPT is the job itself where it is another one's with a scene of its own.
case "${1:-}" in
    -h | --help) sed -n '2,/^[^#]/{/^#SBATCH/d;s/^# \{0,1\}//p;}' "${JOB_SCRIPT:-$0}"; exit 0 ;;
esac

LAUNCH=${LAUNCH:-mpirun -n}
ASKED_TO_END=no # SIGTERM came: somebody, or the batch system, wants this job to be over
NTASKS=${SLURM_NTASKS:-2}
DRY_RUN=${DRY_RUN:-0}
# (a slash at its end would put into OUT what belongs beside it)
while [ "${OUT:-/}" != / ] && [ "${OUT%/}" != "$OUT" ]; do OUT=${OUT%/}; done

# prepare_node: modules, f2s on PATH, compiled kernels on the node's own disk.
prepare_node() {
    cd "$F2S_ROOT" || exit 1
    if [ "$DRY_RUN" = 1 ]; then
        return
    fi
    if [ -n "${F2S_MODULES:-}" ]; then
        # shellcheck disable=SC2086
        module load $F2S_MODULES
    fi
    . scripts/env.sh
    # Network file systems are slow for many small files, and lock them badly.
    if [ -n "${SLURM_JOB_ID:-}" ]; then
        export F2S_CACHE_DIR="${SLURM_TMPDIR:-${TMPDIR:-/tmp}/f2s_hpc-$(id -u)}/kernels"
    fi
    command -v f2s >/dev/null || { echo "f2s is not on PATH: run scripts/setup in $F2S_ROOT first" >&2; exit 1; }
}

# provenance FILE: append what ran where, so that a result can be traced to its job; also into the log.
provenance() {
    [ "$DRY_RUN" = 1 ] && return
    mkdir -p "$(dirname "$1")"
    {
        echo "date      $(date '+%F %T %z')"
        echo "job       ${SLURM_JOB_ID:-none} ${SLURM_JOB_NAME:-} on ${SLURM_JOB_NODELIST:-$(hostname)}, $NTASKS ranks"
        echo "code      $(git describe --always --dirty 2>/dev/null || echo 'no git here')"
        echo "modules   ${LOADEDMODULES:-${F2S_MODULES:-none}}"
        echo "launcher  $LAUNCH"
        echo "kernels   ${F2S_CACHE_DIR:-in the cache of the user}"
    } | tee -a "$1"
}

# run_ranks N COMMAND...: run COMMAND on N ranks and return its exit code. SIGUSR1, which SLURM sends to this
# script before the time limit (#SBATCH --signal=B:USR1@...), goes on to the ranks: f2s then writes a
# checkpoint, ends, and returns 75 ("not finished: start me again").
run_ranks() {
    local count=$1 child code passed_on
    shift
    # shellcheck disable=SC2086
    set -- $LAUNCH "$count" "$@"
    if [ "$DRY_RUN" = 1 ]; then
        printf '%q ' "$@"
        printf '\n'
        return 0
    fi
    echo "$(date '+%F %T') $*"
    "$@" </dev/null &
    child=$!
    passed_on=no
    trap 'echo "time is nearly over: asking the ranks for a checkpoint"; passed_on=yes; kill -USR1 $child' USR1
    # mpirun ends its ranks at once on SIGTERM, and hands SIGUSR1 on to them
    trap 'echo "asked to end: asking the ranks for a checkpoint"; ASKED_TO_END=yes; passed_on=yes; kill -USR1 $child' TERM
    while true; do
        code=0
        wait $child || code=$?
        # A signal interrupts wait; the command itself goes on.
        [ $passed_on = yes ] || break
        passed_on=no
    done
    trap - USR1 TERM
    return $code
}

# timed_run RANKS FOLDER DURATION OPTION...: one short cycle of SCENE without output, the steps timed.
timed_run() {
    local ranks=$1 folder=$2 duration=$3
    shift 3
    run_ranks "$ranks" python -m f2s_hpc.cli.timed_run run "$SCENE" --out "$folder" \
        --set "domain.cell_size=$CELL_SIZE" "$@" \
        --set cycles.count=1 --set "cycles.duration=$duration" --set "cycles.last_duration=$duration" \
        --set particles.flight=eulerian --set output.frames=none --set output.checkpoints=false --set output.picture=false
}

# scaling_study KIND RUN: RUN (timed_run, or a function like it) on RANKS, or 1, 2, 4, ... ranks, then the table.
# Returns the code of the last run that failed.
scaling_study() {
    local ranks code worst=0
    RANKS=${RANKS:-$(for ((n = 1; n <= NTASKS; n *= 2)); do echo $n; done)}
    prepare_node
    provenance "$OUT.jobs.txt"
    # the most ranks: they are on every node, and kernels are compiled on each
    # shellcheck disable=SC2086
    "$2" "$(printf '%s\n' $RANKS | sort -n | tail -n 1)" "$OUT/compile" "1 ns"
    for ranks in $RANKS; do
        code=0
        "$2" "$ranks" "$OUT/ranks-$ranks" "$DURATION" || code=$?
        [ $code -eq 0 ] || { echo "the run on $ranks ranks ended with $code"; worst=$code; }
    done
    [ "$DRY_RUN" = 1 ] || python jobs/scaling_table.py "$1" "$OUT"
    return $worst
}
