//! Styles in bars of three.

use crate::music::score::Voice::{Clap, ClosedHat, Kick, OpenHat, Ride, Rim, Shaker, Snare};
use crate::music::style::{
    Style,
    SwingGrid::{Eighths, Sixteenths},
};

/// Styles in bars of three.
pub const THREE: &[Style] = &[WALTZ, VIENNESE, SLOW_THREE, JAZZ_WALTZ, CLUB_THREE];

const WALTZ: Style = Style {
    name: "waltz",
    beats_per_bar: 3,
    tempo_bpm: (84.0, 132.0),
    swung: Eighths,
    swing: (0.5, 0.53),
    is_live: true,
    grooves: &[
        &[(Kick, "X..........."), (Snare, "....x...x...")],
        &[(Kick, "X..........."), (ClosedHat, "....x...x..."), (Ride, "x...o...o...")],
        &[(Kick, "X..........."), (Rim, "....x...x..."), (Shaker, "x.o.x.o.x.o.")],
    ],
    basses: &["1---........", "1-------....", "1---5---5---"],
    comping: &["....x-..x-..", "x-----------", "0...1...2...", "0.1.2.1.2.1."],
    loops: &[
        "C C G7 G7 G7 G7 C C",
        "C Am Dm G7",
        "F C G7 C",
        "Am Dm E7 Am",
        "C F C G7",
        "Am Am E7 E7 E7 E7 Am Am",
        "C Em F G7",
    ],
    riffs: &["X---x---x---", "X-------x---", "X---x-x-x-x-", "X-----x-X---", "x-x-x-x-X---"],
};

const VIENNESE: Style = Style {
    name: "viennese-waltz",
    tempo_bpm: (150.0, 180.0),
    grooves: &[
        &[(Kick, "X..........."), (Snare, "....x...x...")],
        &[(Kick, "X..........."), (ClosedHat, "....x...x..."), (Snare, "........o...")],
    ],
    comping: &["....x-..x-..", "x-----------"],
    riffs: &["X---x---x---", "X-----------", "X-------x---", "X---------x-"],
    ..WALTZ
};

/// A slow song in three.
const SLOW_THREE: Style = Style {
    name: "ballad-in-three",
    tempo_bpm: (72.0, 104.0),
    grooves: &[
        &[(Kick, "X.........x."), (Snare, "........X..."), (ClosedHat, "x.x.x.x.x.x.")],
        &[(Kick, "X..........."), (Snare, "....X......."), (ClosedHat, "x.x.x.x.x.x.")],
        &[(Kick, "X.....x....."), (Snare, "........X..."), (Ride, "x...x...x...")],
    ],
    basses: &["1-------5---", "1---3---5---", "1-------..a-"],
    comping: &["x---x---x---", "0.1.2.1.2.1.", "x-----------"],
    loops: &["C G Am F", "C Am F G", "Am F C G", "F C Dm G", "Am G F E7"],
    ..WALTZ
};

const JAZZ_WALTZ: Style = Style {
    name: "jazz-waltz",
    tempo_bpm: (112.0, 172.0),
    swing: (0.58, 0.67),
    grooves: &[
        &[(Kick, "X..........."), (Ride, "X...x.x.x..."), (ClosedHat, "....x.......")],
        &[(Kick, "x.........o."), (Ride, "X...x.x.x.x."), (Snare, "......o.x...")],
    ],
    basses: &["1---5---a---", "1-----5-8---", "1---3---5---"],
    comping: &["x.....x.....", "....x.....x.", "x-----x-...."],
    loops: &["Dm7 G7 Cmaj7 A7", "Cmaj7 Fmaj7 Em7 A7", "Am7 D7 Am7 D7"],
    riffs: &["X.x.x...x...", "..x.x.X-....", "X---x.X.x..."],
    ..WALTZ
};

/// Machines in three.
const CLUB_THREE: Style = Style {
    name: "club-in-three",
    tempo_bpm: (96.0, 148.0),
    swung: Sixteenths,
    swing: (0.5, 0.6),
    is_live: false,
    grooves: &[
        &[(Kick, "X..........."), (Clap, "....X...X..."), (ClosedHat, "x.x.x.x.x.x.")],
        &[(Kick, "X.....x....."), (Snare, "........X..."), (ClosedHat, "xoxoxoxoxoxo")],
        &[(Kick, "X...X...X..."), (Clap, "........X..."), (OpenHat, "..x...x...x.")],
    ],
    basses: &["1-..1-..5-..", "..1-..1-..1-", "1-------..8-"],
    comping: &["..x-..x-..x-", "x-----x-----", "0.1.2.0.1.2."],
    loops: &["Am F C G", "Am7 Dm7", "Am G F G", "Fmaj7 Em7 Am7 Am7"],
    riffs: &["X..x..x..x..", "X.x.x...X...", "X--x--X-----"],
    ..WALTZ
};
