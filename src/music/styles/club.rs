//! Styles of machines, in bars of four.

use crate::music::score::Voice::{Clap, ClosedHat, Kick, OpenHat, Rim, Shaker, Snare, Tom};
use crate::music::style::{Style, SwingGrid::Sixteenths};

const MINOR: &[&str] = &[
    "Am F C G",
    "Am G F G",
    "Am7 Am7 Dm7 Em7",
    "Am Am F G",
    "Am Em F G",
    "F G Am Am",
    "Am7 D7 Am7 D7",
    "Am C G D",
];
const MAJOR: &[&str] =
    &["C G Am F", "F C G Am", "Fmaj7 Em7 Dm7 Cmaj7", "C F Am G", "Fmaj7 G Em7 Am7"];
const STATIC: &[&str] = &["Am Am Am Am", "Am Am Am G", "Am Am F Am", "Dm7 Dm7 Dm7 Am7"];

const RIFFS: &[&str] = &[
    "X..x..x.X.......",
    "X.x.x...X.x.....",
    "..X...x...X.x...",
    "X--x--x-X---....",
    "X.xx.x.xX.......",
    "....X-x-X---x---",
    "X..x..X..x..X.x.",
];
const STABS: &[&str] = &[
    "..x-..x-..x-..x-",
    "x..x..x...x..x..",
    "x---------------",
    "..x...x.x..x....",
    "0.1.2.1.0.1.2.3.",
    "x.......x..x....",
];

pub const HOUSE: Style = Style {
    name: "house",
    beats_per_bar: 4,
    tempo_bpm: (118.0, 130.0),
    swung: Sixteenths,
    swing: (0.5, 0.58),
    is_live: false,
    grooves: &[
        &[
            (Kick, "X...X...X...X..."),
            (Clap, "....X.......X..."),
            (OpenHat, "..x...x...x...x."),
            (ClosedHat, "x..ox..ox..ox..o"),
        ],
        &[
            (Kick, "X...X...X...X.o."),
            (Snare, "....x.......x..o"),
            (OpenHat, "..X...X...X...X."),
            (Shaker, "oxoxoxoxoxoxoxox"),
        ],
        &[
            (Kick, "X...X...X...X..."),
            (Clap, "....X.......X..."),
            (ClosedHat, "..x.o.x...xo..x."),
            (Rim, "...x..x....x..x."),
        ],
    ],
    basses: &["..1-..1-..1-..1-", "1--1..1...1-..8.", "1..1..1.1..1..5.", "..11..11..11..11"],
    comping: STABS,
    loops: MINOR,
    riffs: RIFFS,
};

pub const TECHNO: Style = Style {
    name: "techno",
    beats_per_bar: 4,
    tempo_bpm: (126.0, 142.0),
    swung: Sixteenths,
    swing: (0.5, 0.54),
    is_live: false,
    grooves: &[
        &[
            (Kick, "X...X...X...X..."),
            (OpenHat, "..X...X...X...X."),
            (ClosedHat, "oooxoooxoooxooox"),
            (Clap, "....x.......x..."),
        ],
        &[
            (Kick, "X...X...X...X..."),
            (ClosedHat, "..x...x...x...x."),
            (Rim, "x..x..x.x..x..x."),
            (Tom, "......o.......oo"),
        ],
    ],
    basses: &["..11..11..11..11", ".111.111.111.111", "1.1.1.1.1.1.1.1.", "..1...1...1...1."],
    comping: &["x..x..x..x..x...", "x---............", "..x...x...x...x.", "....x-......x-.."],
    loops: STATIC,
    riffs: &["X..x..x..x..x...", "X.x.X.x.X.x.X.x.", "..x..x..x..x..x."],
};

pub const TRANCE: Style = Style {
    name: "trance",
    tempo_bpm: (132.0, 142.0),
    swing: (0.5, 0.5),
    grooves: &[&[
        (Kick, "X...X...X...X..."),
        (Clap, "....X.......X..."),
        (OpenHat, "..X...X...X...X."),
        (ClosedHat, "xoxoxoxoxoxoxoxo"),
    ]],
    basses: &["..1...1...1...1.", ".111.111.111.111", "..11..11..11..18"],
    comping: &["0120120101201201", "x-.x-.x-.x-.x-x-", "x---------------", "0123210301232103"],
    loops: MAJOR,
    riffs: &["X--x--x-X-x-x---", "X-------x---x---", "X--x--X--x--X-x-"],
    ..HOUSE
};

pub const DISCO: Style = Style {
    name: "disco",
    tempo_bpm: (108.0, 126.0),
    swing: (0.5, 0.54),
    is_live: true,
    grooves: &[
        &[
            (Kick, "X...X...X...X..."),
            (Snare, "....X.......X..."),
            (OpenHat, "..X...X...X...X."),
            (ClosedHat, "xx.xxx.xxx.xxx.x"),
        ],
        &[
            (Kick, "X...X...X...X..."),
            (Snare, "....X..o....X..."),
            (Clap, "....x.......x..."),
            (ClosedHat, "x.xxx.xxx.xxx.xx"),
        ],
    ],
    basses: &["1.8.1.8.1.8.1.8.", "1..8..1.1..8.a8.", "1-.8.81-5-.8.85-", "1...5...8...5.a."],
    comping: &["x.x..x.xx.x..x.x", "..x...x...x...x.", "x..x..x..x..x.x.", "x---....x-..x-.."],
    loops: &["Am7 D7 Am7 D7", "C Am Dm7 G7", "Am F G Em", "Fmaj7 Em7 Dm7 G7", "Am C D F"],
    ..HOUSE
};

pub const HIP_HOP: Style = Style {
    name: "hip-hop",
    tempo_bpm: (76.0, 102.0),
    swing: (0.54, 0.64),
    is_live: false,
    grooves: &[
        &[(Kick, "X......x..X....."), (Snare, "....X.......X..."), (ClosedHat, "x.x.x.x.x.x.x.x.")],
        &[
            (Kick, "X..x......X..x.."),
            (Snare, "....X..o.o..X..."),
            (ClosedHat, "x.xxx.x.x.xxx.x."),
            (OpenHat, "..............x."),
        ],
        &[
            (Kick, "X.....x...x....."),
            (Clap, "....X.......X..."),
            (Rim, "..........x....."),
            (Shaker, "x.x.x.x.x.x.x.x."),
        ],
    ],
    basses: &["1--....1..1-....", "1---..5...1-..3.", "1-....1-..8-a...", "1-------....5-a-"],
    comping: &["x-------x-------", "....x-......x-..", "x-..........x-..", "0.2.1...0.2.1..."],
    loops: &["Am7 Dm7", "Am F Dm Em", "Dm7 G7 Cmaj7 Am7", "Am7 Am7 Fmaj7 Em7", "Am E7 Am E7"],
    riffs: &["X..x..x.....x...", "X.x.......X.x...", "....X.x.X.......", "X...x..x..X....."],
    ..HOUSE
};

pub const BREAKBEAT: Style = Style {
    name: "breakbeat",
    tempo_bpm: (104.0, 136.0),
    swing: (0.5, 0.58),
    grooves: &[
        &[(Kick, "X.x.......xx...."), (Snare, "....X..o.o..X..o"), (ClosedHat, "x.x.x.x.x.x.x.x.")],
        &[(Kick, "X.....x...x....."), (Snare, "....X..x.x....X."), (ClosedHat, "xxxxxxxxxxxxxxxx")],
        &[
            (Kick, "X..x..x...X....."),
            (Snare, "....X.......X..."),
            (OpenHat, "..x...x...x...x."),
            (Shaker, "oxoxoxoxoxoxoxox"),
        ],
    ],
    basses: &["1--1....1-8-....", "1.1...5.1...a...", "1-----..1-3-5-a-"],
    loops: MINOR,
    ..HOUSE
};

pub const DRUM_AND_BASS: Style = Style {
    name: "drum-and-bass",
    tempo_bpm: (160.0, 178.0),
    swing: (0.5, 0.55),
    grooves: &[
        &[(Kick, "X.........X....."), (Snare, "....X.......X..."), (ClosedHat, "x.x.x.x.x.x.x.x.")],
        &[(Kick, "X.........x....."), (Snare, "....X..o.o..X..o"), (ClosedHat, "xoxoxoxoxoxoxoxo")],
        &[(Kick, "X.x.......x....."), (Snare, "....X.......X.o."), (Shaker, "x.x.x.x.x.x.x.x.")],
    ],
    basses: &["1-------------a-", "1-----1-....5---", "1-..1-..8-..5-..", "1---------1-1---"],
    comping: &["x---------------", "x-----..x-......", "..........x-....", "0...1...2...1..."],
    loops: &["Am Am F F", "Am7 Am7 Dm7 Dm7", "Am F C G", "Fmaj7 Fmaj7 Em7 Am7"],
    ..HOUSE
};

/// Half time: the snare on the third beat alone.
pub const HALF_TIME: Style = Style {
    name: "half-time",
    tempo_bpm: (132.0, 150.0),
    swing: (0.5, 0.58),
    grooves: &[
        &[(Kick, "X.....x........."), (Snare, "........X......."), (ClosedHat, "x.x.x.x.x.x.x.x.")],
        &[
            (Kick, "X..x......x..x.."),
            (Clap, "........X......."),
            (ClosedHat, "xoxoxoxoxoxxxoxo"),
            (OpenHat, "..............x."),
        ],
    ],
    basses: &["1---------------", "1-----1-....8-a-", "1-1-..1-........"],
    comping: &["x---------------", "x-..........x-..", "....x-......x-.."],
    loops: STATIC,
    ..HOUSE
};

pub const DEMBOW: Style = Style {
    name: "dembow",
    tempo_bpm: (86.0, 104.0),
    swing: (0.5, 0.54),
    grooves: &[
        &[(Kick, "X...X...X...X..."), (Snare, "...x..x....x..x."), (ClosedHat, "x.x.x.x.x.x.x.x.")],
        &[
            (Kick, "X...x...X...x..."),
            (Rim, "...X..X....X..X."),
            (Shaker, "x.x.x.x.x.x.x.x."),
            (Clap, "......x.......x."),
        ],
    ],
    basses: &["1--1..1-1--1..5-", "1-....1-1-....5-", "1...1...1...5.a."],
    comping: &["...x..x....x..x.", "x-----..x-----..", "0..1..2.0..1..2."],
    loops: &["Am F C G", "Dm Am E Am", "Am G F E7", "C G Am F"],
    riffs: MAJOR_RIFFS,
    ..HOUSE
};

const MAJOR_RIFFS: &[&str] = &["X..x..x.X..x..x.", "X.x.x..X..x.....", "x.X.x.X.x...X---"];
