"""Writes tunes.tsv: the notes that music21 10.5.1 (pip install music21==10.5.1) reads in tunes.abc.

A line per note: number of the tune, onset and duration in quarters from its first note on as it is played
(repeats and endings written out, ties joined), and MIDI pitch. Grace notes have no duration and are left out.
"""
from fractions import Fraction
from pathlib import Path

from music21 import converter

here = Path(__file__).parent
lines = []
texts = (here / "tunes.abc").read_text().split("\nX:")[1:]
for text in texts:
    number = int(text.split()[0])
    part = converter.parse("%abc-2.1\nM:4/4\nL:1/8\nX:" + text, format="abc")
    part = part.parts[0] if part.parts else part
    played = part.expandRepeats().stripTies()
    for element in played.flatten().notes:
        if element.duration.quarterLength == 0 or element.duration.isGrace:
            continue
        if "ChordSymbol" in element.classes:
            continue
        for pitch in element.pitches:
            onset = Fraction(element.offset).limit_denominator(5040)
            length = Fraction(element.duration.quarterLength).limit_denominator(5040)
            lines.append((number, onset, length, pitch.midi))
lines.sort()
with (here / "tunes.tsv").open("w") as out:
    out.write("tune\tonset\tduration\tpitch\n")
    for line in lines:
        out.write("\t".join(str(value) for value in line) + "\n")
