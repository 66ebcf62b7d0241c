#!/usr/bin/env bash
# stamp.sh prune FOLDER              removes the stamps of FOLDER that are not of the present files
# stamp.sh run STAMP FILE… [--made FILE…] -- COMMAND…
#                                    runs a stage and, when it is done, stamps it with the digests of the files that it
#                                    needed, as they were before, and of those that it made
#
# A stamp is a list of digests (sha256sum) of what a stage was run for: lists of a source, settings, the program, the
# stamps of the stages before it, and files that it made. It counts while all of them are as they were; clocks say
# nothing. A stamp that goes takes along those of the stages after it.
set -euo pipefail

prune() {
    local folder=$1 stamp again=1
    while [ "$again" = 1 ]; do
        again=0
        for stamp in "$folder"/*.done; do
            [ -e "$stamp" ] || continue
            if ! [ -s "$stamp" ] || ! sha256sum --check --status --strict "$stamp" 2> /dev/null; then
                rm -f "$stamp"
                again=1
            fi
        done
    done
}

run() {
    local stamp=$1 code=0 needed=() made=()
    shift
    while [ "$1" != -- ] && [ "$1" != --made ]; do
        needed+=("$1")
        shift
    done
    [ "$1" = -- ] || shift
    while [ "$1" != -- ]; do
        made+=("$1")
        shift
    done
    shift
    mkdir -p "$(dirname "$stamp")"
    rm -f "$stamp"
    # Before the stage begins: what changes while it runs is done next time. Of a stage before it that has no stamp,
    # some items failed; then this one cannot be known as done either.
    local digests
    digests=$(sha256sum "${needed[@]}" 2> /dev/null) || digests=
    echo "$*"
    "$@" || code=$?
    case $code in
    0)
        if [ -n "$digests" ]; then
            {
                echo "$digests"
                [ "${#made[@]}" = 0 ] || sha256sum "${made[@]}"
            } > "$stamp.new"
            mv "$stamp.new" "$stamp"
        fi
        ;;
    1)
        echo "$(basename "$stamp" .done): some items failed (see above); going on, they are tried again next time" >&2
        ;;
    75)
        echo "$(basename "$stamp" .done): stopped before it was done; run make again to go on" >&2
        exit 75
        ;;
    *) exit "$code" ;;
    esac
}

action=$1
shift
"$action" "$@"
