#!/usr/bin/env bash
# mpirun for `motiongen train`, with the exit codes that schedulers of motiongen know.
#
#   pipelines/mpi/mpirun.sh -n 4 motiongen train --store gs://bucket/tables --run night --side-by-side 4
#
# What mpirun takes goes to mpirun. Ends with 75 when a rank was killed or its machine was lost, and when training was asked
# to end (SIGTERM or Ctrl-C to this script, or SIGTERM to any rank): the same command goes on from the last checkpoint. Else it
# ends as the ranks do. MPIRUN names mpirun.
set -uo pipefail

MPIRUN=${MPIRUN:-mpirun}
command -v "$MPIRUN" > /dev/null || {
    echo "error: $MPIRUN was not found on $(hostname), so there is no MPI library here; install Open MPI, or name mpirun in MPIRUN" >&2
    exit 2
}
for word in "$@"; do
    case $word in
    motiongen | */motiongen | motiongen-train | */motiongen-train)
        missing=$(ldd "$(command -v "$word")" 2> /dev/null | awk '/libmpi.*not found/ { print $1; exit }')
        [ -z "$missing" ] || {
            echo "error: $word needs $missing, an MPI library that is not on $(hostname); install the one that it was built with" >&2
            exit 2
        }
        break
        ;;
    esac
done

# mpirun would kill the ranks a second after a signal; they finish the step and its checkpoint instead. One is enough: ranks
# ask each other before each step.
asked=0 launcher=
ask() {
    asked=1
    [ -z "$launcher" ] || pkill -TERM -P "$launcher" || kill -TERM "$launcher" 2> /dev/null || true
}
trap ask TERM INT
"$MPIRUN" "$@" &
launcher=$!
[ "$asked" = 0 ] || ask
code=0
wait "$launcher" || code=$?
# A signal ends the wait, not mpirun.
while [ "$asked" = 1 ] && kill -0 "$launcher" 2> /dev/null; do
    code=0
    wait "$launcher" || code=$?
done

if [ "$code" -gt 128 ]; then
    echo "a rank was killed; the same command goes on from the last checkpoint" >&2
    exit 75
fi
exit "$code"
