#!/usr/bin/env bash
# Submits the stages of a pipeline to Slurm as a chain of jobs, arrays where a stage has shards:
#
#   make cluster SOURCE=gs://bucket/music STORE=gs://bucket/tables RUN=night
#   make cluster … DRY_RUN=1          prints the commands, as a script
#   make cluster … AGAIN=1            submits only what motiongen status finds to be left
#
# Settings are variables of the environment (docs/cluster.md):
#
#   SOURCE STORE RUN    music (or phrases), tables, and the name of run and model; folders that every node sees, or URLs
#   MODEL               what generate and evaluate take instead of RUN, such as pretrained; then leave train and export out
#   STAGES              ingest extract library train export generate evaluate, or some of them, in this order
#   SHARDS PARALLEL     tasks of an array (16), a power of two so that shards hold whole batches; most that run at once
#   CONFIG              TOML file with the stages' settings, which every node sees
#   LOGS                folder of the logs (build/cluster/logs), which every node sees
#   MOTIONGEN           the executable, which every node sees
#   SBATCH              flags of sbatch for every job, such as '--partition=main --account=dance'
#   INGEST … EVALUATE   flags of one stage; INGEST_SBATCH … EVALUATE_SBATCH  flags of sbatch for its job
set -euo pipefail

here=$(cd "$(dirname "$0")" && pwd)
refuse() {
    echo "error: $*" >&2
    exit 2
}
is_folder() { [[ $1 != *://* ]]; }
absolute() { if is_folder "$1"; then realpath -m -- "$1"; else echo "$1"; fi; }
is_bulk() { [[ " ingest extract generate " = *" $1 "* ]]; }

STAGES=${STAGES:-ingest extract library train export generate evaluate}
SHARDS=${SHARDS:-16}
MODEL=${MODEL:-${RUN:-}}
DRY_RUN=${DRY_RUN:-}
AGAIN=${AGAIN:-}
MOTIONGEN=${MOTIONGEN:-motiongen}

[ -n "${STORE:-}" ] || refuse "name the store: make cluster SOURCE=music STORE=tables RUN=name"
for stage in $STAGES; do
    case $stage in
    ingest) [ -n "${SOURCE:-}" ] || refuse "name the source: make cluster SOURCE=music STORE=tables RUN=name" ;;
    extract | library) ;;
    train | export) [ -n "${RUN:-}" ] || refuse "name the run: make cluster SOURCE=music STORE=tables RUN=name" ;;
    generate | evaluate)
        [ -n "$MODEL" ] || refuse "name the run or a model: make cluster SOURCE=music STORE=tables RUN=name"
        ;;
    *) refuse "STAGES has \"$stage\"; it may have ingest, extract, library, train, export, generate and evaluate" ;;
    esac
done
[[ $SHARDS =~ ^[1-9][0-9]*$ ]] || refuse "SHARDS is \"$SHARDS\"; give a number of tasks, such as 16"
[ -n "$DRY_RUN" ] || command -v sbatch > /dev/null ||
    refuse "sbatch was not found, so there is no Slurm here; DRY_RUN=1 prints the commands, make ingest works without"
[ -n "$DRY_RUN" ] && [ -z "$AGAIN" ] || command -v "$MOTIONGEN" > /dev/null ||
    refuse "$MOTIONGEN is missing; build it with: cargo build --bins (or name another with MOTIONGEN=…)"

STORE=$(absolute "$STORE")
[ -z "${SOURCE:-}" ] || SOURCE=$(absolute "$SOURCE")
[ -z "${CONFIG:-}" ] || CONFIG=$(absolute "$CONFIG")
LOGS=$(absolute "${LOGS:-build/cluster/logs}")
[[ $MOTIONGEN != */* ]] || MOTIONGEN=$(absolute "$MOTIONGEN")
export MOTIONGEN SHARDS

# A mark in the store's folder, by which nodes know that they see the same one.
if [ -z "$DRY_RUN" ]; then
    mkdir -p "$LOGS"
    if is_folder "$STORE"; then
        mkdir -p "$STORE"
        [ -s "$STORE/.cluster" ] || echo "$RANDOM$RANDOM$RANDOM$RANDOM" > "$STORE/.cluster"
        STORE_FOLDER=$STORE STORE_TOKEN=$(cat "$STORE/.cluster")
        export STORE_FOLDER STORE_TOKEN
    fi
fi

# command_of STAGE: fills `command`, the stage and its flags.
command_of() {
    command=("$1")
    [ -z "${CONFIG:-}" ] || command+=(--config "$CONFIG")
    [ "$1" != ingest ] || command+=(--source "$SOURCE")
    command+=(--store "$STORE")
    case $1 in
    train) command+=(--run "$RUN") ;;
    export) command+=(--run "$RUN" --model "$MODEL") ;;
    generate) command+=(--model "$MODEL") ;;
    evaluate) command+=(--run "$MODEL") ;;
    esac
    local flags=${1^^}
    # Words as a shell splits them, quotes included.
    [ -z "${!flags:-}" ] || eval "command+=(${!flags})"
}

# left STAGE: prints what is left of a stage, as an array of shards or item by item; nothing where nothing is.
left() {
    local code=0 asked=(--store "$STORE" --stage "$1" --missing)
    ! is_bulk "$1" || asked+=("$SHARDS")
    case $1 in
    ingest) asked+=(--source "$SOURCE") ;;
    train) asked+=(--run "$RUN") ;;
    generate | evaluate) asked+=(--run "$MODEL") ;;
    esac
    "$MOTIONGEN" status "${asked[@]}" || code=$?
    # 1 says that items failed, 75 that work is left.
    case $code in 0 | 1 | 75) ;; *) exit "$code" ;; esac
}

# submit STAGE ARRAY: submits the stage's job behind the last one.
after=
submit() {
    local stage=$1 array=$2 flags=${1^^}_SBATCH words variable=${1^^}_JOB job
    command_of "$stage"
    words=(sbatch --parsable --job-name="motiongen-$stage" --cpus-per-task=2 --mem=4G --time=04:00:00)
    if [ -n "$array" ]; then
        words+=(--array="$array${PARALLEL:+%$PARALLEL}" --output="$LOGS/%x-%A_%a.log")
    else
        words+=(--output="$LOGS/%x-%j.log")
    fi
    [ -z "${SBATCH:-}" ] || eval "words+=($SBATCH)"
    [ -z "${!flags:-}" ] || eval "words+=(${!flags})"
    if [ -n "$DRY_RUN" ]; then
        [ -z "$after" ] || after=" --kill-on-invalid-dep=yes --dependency=afterok:\$$after"
        echo "$variable=\$(SHARDS=$SHARDS MOTIONGEN=$(printf %q "$MOTIONGEN") $(printf '%q ' "${words[@]}" | sed 's/ $//')$after" \
            "$(printf '%q ' "$here/stage.sbatch" "${command[@]}" | sed 's/ $//'))"
        after=$variable
        return
    fi
    [ -z "$after" ] || words+=(--kill-on-invalid-dep=yes --dependency="afterok:$after")
    job=$("${words[@]}" "$here/stage.sbatch" "${command[@]}")
    # With several clusters the number is followed by the cluster's name.
    after=${job%%;*}
    printf '%-9s job %s%s\n' "$stage" "$after" "${array:+, tasks $array of $SHARDS shards}"
}

has_work=0
for stage in $STAGES; do
    array=
    ! is_bulk "$stage" || array=0-$((SHARDS - 1))
    # What comes behind a stage that has work left may have work in any shard. export sees for itself in a moment.
    if [ -n "$AGAIN" ] && [ "$has_work" = 0 ] && [ "$stage" != export ]; then
        found=$(left "$stage")
        if [ -z "$found" ]; then
            echo "# $stage: nothing is left"
            continue
        fi
        ! is_bulk "$stage" || array=$found
        has_work=1
    fi
    submit "$stage" "$array"
done
[ -n "$DRY_RUN" ] || echo "watch   squeue --me; then: $MOTIONGEN status --store $STORE"
