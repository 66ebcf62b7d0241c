#!/usr/bin/env bash
# watch.sh FILE SOURCE [SETTING…]
#
# Writes the settings and what the folder SOURCE holds (paths, sizes, times) into FILE, which stays as it is if
# nothing changed. So a file is seen that came, went or changed, whatever its name. A remote source cannot be seen
# from here: it always counts as changed, and the stage looks itself.
#
# watch.sh --program FILE PROGRAM
#
# Writes the digest of PROGRAM into FILE; it is taken again only where its size or time is another than before.
set -euo pipefail

put() { # put FILE: standard input becomes FILE, unless it is that already
    cat > "$1.new"
    if cmp --quiet "$1.new" "$1"; then rm "$1.new"; else mv "$1.new" "$1"; fi
}

if [ "$1" = --program ]; then
    file=$2 program=$3
    mkdir -p "$(dirname "$file")"
    seen=$(stat -L --format '%s %Y %i' "$program" 2> /dev/null || echo missing)
    if [ ! -e "$file" ] || [ "$seen" != "$(cat "$file.seen" 2> /dev/null)" ]; then
        { sha256sum "$program" 2> /dev/null || echo missing; } | put "$file"
        echo "$seen" | put "$file.seen"
    fi
    exit
fi

file=$1
shift
mkdir -p "$(dirname "$file")"
{
    printf '%s\n' "$@"
    case $1 in
    *://*) date +%s.%N ;;
    *) [ ! -d "$1" ] || find -L "$1" -type f -printf '%P\t%s\t%T@\n' | LC_ALL=C sort ;;
    esac
} | put "$file"
