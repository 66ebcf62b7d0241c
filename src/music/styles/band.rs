//! Styles of bands, in bars of four.

use crate::music::score::Voice::{ClosedHat, Kick, OpenHat, Ride, Rim, Shaker, Snare, Tom};
use crate::music::style::{
    Style,
    SwingGrid::{Eighths, Sixteenths},
};

pub const ROCK: Style = Style {
    name: "rock",
    beats_per_bar: 4,
    tempo_bpm: (96.0, 152.0),
    swung: Eighths,
    swing: (0.5, 0.52),
    is_live: true,
    grooves: &[
        &[(Kick, "X.......x.x....."), (Snare, "....X.......X..."), (ClosedHat, "x.x.x.x.x.x.x.x.")],
        &[(Kick, "X.....x.x......."), (Snare, "....X.......X..."), (Ride, "X.x.x.x.X.x.x.x.")],
        &[(Kick, "X...x...X...x..."), (Snare, "..x...x...x...x."), (ClosedHat, "x.x.x.x.x.x.x.x.")],
        &[(Kick, "X..x..x...x....."), (Snare, "....X.......X..."), (OpenHat, "x...x...x...x...")],
    ],
    basses: &["1.1.1.1.1.1.1.1.", "1.1.1.1.5.5.8.a.", "1-----1-1-......", "1---1---1---1-a-"],
    comping: &["x-x-x-x-x-x-x-x-", "x-------x---x---", "x---..x-x---....", "x-..x-x-..x-x-.."],
    loops: &[
        "C F G C",
        "C G Am F",
        "A D E D",
        "C Bb F C",
        "Am G F G",
        "C5 C5 Eb5 F5",
        "C7 F7 C7 C7 F7 F7 C7 C7 G7 F7 C7 G7",
    ],
    riffs: &[
        "X.x.x.x.X---....",
        "X---x-x-X-------",
        "x.x.X...x.x.X...",
        "..x.x.x.X---x---",
        "X--x--X-......x.",
    ],
};

pub const BALLAD: Style = Style {
    name: "ballad",
    tempo_bpm: (70.0, 92.0),
    grooves: &[
        &[(Kick, "X.......x......."), (Snare, "....X.......X..."), (ClosedHat, "x.x.x.x.x.x.x.x.")],
        &[(Kick, "X......xx......."), (Rim, "....x.......x..."), (ClosedHat, "x.o.x.o.x.o.x.o.")],
        &[(Kick, "X.....x.x.....x."), (Snare, "....X.......X..."), (Ride, "x.o.x.o.x.o.x.o.")],
    ],
    basses: &["1-------1-----5-", "1-------5-------", "1---------------", "1-----3-5-----a-"],
    comping: &["x---x---x---x---", "x---------------", "0.1.2.1.0.1.2.1.", "0.1.2.3.2.1.2.1."],
    loops: &[
        "C Am F G",
        "C G Am F",
        "F G Em Am",
        "C Em F G",
        "Am F C G",
        "Cmaj7 Am7 Dm7 G7",
        "C G/B Am F",
    ],
    riffs: &["X-----x-X---x---", "X-------x---X---", "....x-x-X-------", "X---x---X-------"],
    ..ROCK
};

pub const FUNK: Style = Style {
    name: "funk",
    tempo_bpm: (92.0, 118.0),
    swung: Sixteenths,
    swing: (0.5, 0.58),
    grooves: &[
        &[(Kick, "X.x.......x..x.."), (Snare, "....X..o.o..X..o"), (ClosedHat, "xxxxxxxxxxxxxxxx")],
        &[
            (Kick, "X..x..x...x....."),
            (Snare, "....X..o.o.oX..."),
            (ClosedHat, "x.xxx.xxx.xxx.x."),
            (OpenHat, ".......x......x."),
        ],
    ],
    basses: &["1..1..8.1.5..8a.", "1...1.8...1.3.5.", "1-.1.....1.8..a.", "1..5..8..5.1..a."],
    comping: &["x..x..x...x..x..", "....x..x....x.x.", "x.x.......x.x...", "..xx..x...xx..x."],
    loops: &["Am7 D9", "C9 C9 F9 C9", "Dm7 Dm7 G7 G7", "Am7 Am7 Am7 D7"],
    riffs: &["X..x..x.......xx", "..X.x..x..X.....", "X.xx....X.x.....", "....X..x..x.X..."],
    ..ROCK
};

pub const REGGAE: Style = Style {
    name: "reggae",
    tempo_bpm: (122.0, 158.0),
    swing: (0.5, 0.62),
    grooves: &[
        &[(Kick, "........X......."), (Rim, "........X......."), (ClosedHat, "x.x.x.x.x.x.x.x.")],
        &[(Kick, "X...X...X...X..."), (Snare, "........X......."), (ClosedHat, "x.x.x.x.x.x.x.x.")],
        &[(Kick, "X.......X......."), (Snare, "........X.....o."), (ClosedHat, "..x...x...x...x.")],
    ],
    basses: &["1---..1-5---....", "1---3---5---..a-", "....1-1-5-8-....", "1---1-..3-5-8---"],
    comping: &["....x-......x-..", "....x.x.....x.x.", "....x-......x-x-"],
    loops: &["Am G Am G", "C F C G", "Am Dm Am Em", "C G F C", "Am F G Am"],
    riffs: &["X---x---X-------", "..x.x.X---......", "X-x-X---....x---", "....X---x-x-X---"],
    ..ROCK
};

pub const SWING: Style = Style {
    name: "swing",
    tempo_bpm: (108.0, 178.0),
    swing: (0.6, 0.68),
    grooves: &[
        &[(Kick, "x...o...x...o..."), (Ride, "X...x.x.X...x.x."), (ClosedHat, "....x.......x...")],
        &[(Kick, "X.......x......."), (Snare, "....x.......x..."), (Ride, "X...x.x.X...x.x.")],
        &[(Kick, "X...X...X...X..."), (Snare, "....X.......X..."), (ClosedHat, "x...x.x.x...x.x.")],
    ],
    basses: &["1---3---5---a---", "1---5---3---a---", "1---3---5---8---", "1-1-3-3-5-5-a-a-"],
    comping: &["....x.......x...", "x.....x.........", "..x.......x.....", "x..........x...."],
    loops: &[
        "C6 A7 Dm7 G7",
        "Dm7 G7 Cmaj7 A7",
        "Am6 Am6 Dm6 E7",
        "C7 F7 C7 C7 F7 F7 C7 A7 Dm7 G7 C7 G7",
        "Cmaj7,Am7 Dm7,G7 Em7,A7 Dm7,G7",
    ],
    riffs: &["X.x.x...X.......", "..x.x.X.x...X...", "X...x.X---..x.x.", "x.x.x.x.X---...."],
    ..ROCK
};

pub const BOSSA: Style = Style {
    name: "bossa",
    tempo_bpm: (112.0, 148.0),
    grooves: &[&[
        (Kick, "X.....x.x.....x."),
        (Rim, "x.....x.....x..."),
        (ClosedHat, "x.x.x.x.x.x.x.x."),
    ]],
    basses: &["1-----5-5-----1-", "1-----5-8-----a-"],
    comping: &["x...x.x...x...x.", "x.....x-....x-..", "..x...x.x...x..."],
    loops: &["Cmaj7 Dm7 G7 Cmaj7", "Am7 Dm7 E7 Am7", "Dm7 G7 Cmaj7 Fmaj7", "Fmaj7 G7 Em7 Am7"],
    riffs: &["X-----x-X---x---", "..x.x.X---..x.x.", "X---..x-x-..X---"],
    ..ROCK
};

pub const SALSA: Style = Style {
    name: "salsa",
    tempo_bpm: (156.0, 180.0),
    grooves: &[
        &[
            (Kick, "......x.....x..."),
            (Rim, "X.....x.....X..."),
            (Shaker, "X.o.x.o.X.o.x.o."),
            (Tom, "............x.x."),
        ],
        &[(Kick, "X.....x.....x..."), (Rim, "....x...x......."), (ClosedHat, "X...x.x.X...x.x.")],
    ],
    basses: &["......5-....8---", "1-....5-....8-..", "1-----5-....a---"],
    comping: &["x.x.x..x.x.x.x..", "x...x.x...x.x...", "0.12.1.20.12.1.2"],
    loops: &["Am Dm E7 Dm", "C F G F", "Dm7 G7 Cmaj7 A7", "Am G F E7"],
    riffs: &["X.x.x...X.x.....", "..x.X.x.x...X...", "X---x-X---x-...."],
    ..ROCK
};

pub const MARCH: Style = Style {
    name: "march",
    tempo_bpm: (104.0, 132.0),
    grooves: &[
        &[(Kick, "X.......X......."), (Snare, "x.ooX.o.x.ooX.oo")],
        &[(Kick, "X...x...X...x..."), (Snare, "..x...x...x...xx")],
    ],
    basses: &["1---5---1---5---", "1---5---3---5---"],
    comping: &["..x...x...x...x.", "....x.......x...", "x---x---x---x---"],
    loops: &["C C G7 C", "C F G7 C", "C G7 G7 C", "F C G7 C", "C Am Dm G7"],
    riffs: &["X--xX-x-X---x---", "X---x-x-X-x-X---", "x-x-X---x-x-X---"],
    ..ROCK
};
