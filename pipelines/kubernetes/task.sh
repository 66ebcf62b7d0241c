#!/bin/sh
# What runs in a container: `motiongen STAGE FLAGS…`, its exit codes as an indexed job wants them.
#
# A stage that ends with 1 did its work; the items that failed are in the table of failures. A job would count its pod as
# failed and run it again for nothing, so it ends with 0 here. 75 (stopped, by an eviction for example) and 2 (could not
# run) are left to the job's podFailurePolicy.
set -u
asked=0
stage=
# As the first process of a container it has to hand the signal on; the stage finishes what is under way.
trap 'asked=1; [ -z "$stage" ] || kill -TERM "$stage" 2> /dev/null' TERM INT
"${MOTIONGEN:-motiongen}" "$@" &
stage=$!
[ "$asked" = 0 ] || kill -TERM "$stage" 2> /dev/null
wait "$stage"
code=$?
# A signal ends the wait, not the stage.
if [ "$asked" = 1 ]; then
    wait "$stage"
    code=$?
fi
if [ "$code" = 1 ]; then
    echo "some items failed; they are in the table of failures" >&2
    exit 0
fi
exit "$code"
