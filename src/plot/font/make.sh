#!/bin/sh
# Makes DejaVuSans-subset.ttf: Latin, Greek, Cyrillic, digits and the signs that plots use.
# Needs DejaVu Sans 2.37 (Debian package fonts-dejavu-core) and fonttools 4.68.0 (pip).
# Usage: sh make.sh PATH/TO/DejaVuSans.ttf
set -eu
SOURCE_DATE_EPOCH=0 pyftsubset "$1" \
    --unicodes="U+0020-007E,U+00A0-017F,U+0218-021B,U+0370-03FF,U+0400-045F,U+2013-2014,U+2018-201A,U+201C-201E,U+2022,U+2026,U+2032-2033,U+2190,U+2192,U+2212,U+2260,U+2264-2265,U+266D-266F" \
    --legacy-kern --layout-features= --drop-tables+=FFTM,GDEF,GPOS,GSUB,MATH \
    --no-hinting --notdef-outline --output-file="$(dirname "$0")/DejaVuSans-subset.ttf"
