#!/usr/bin/env bash
# watch.sh FILE SOURCE [SETTING…]
#
# Writes the settings and what the folder SOURCE holds (paths, sizes, times) into FILE, which keeps
# its own time if nothing changed. So make sees a file that came, went or changed, whatever its name.
# A remote source cannot be seen from here: it always counts as changed, and the stage looks itself.
set -euo pipefail

file=$1
shift
mkdir -p "$(dirname "$file")"
{
    printf '%s\n' "$@"
    case $1 in
    *://*) date +%s.%N ;;
    *) [ ! -d "$1" ] || find -L "$1" -type f -printf '%P\t%s\t%T@\n' | LC_ALL=C sort ;;
    esac
} > "$file.new"
if cmp --quiet "$file.new" "$file"; then rm "$file.new"; else mv "$file.new" "$file"; fi
