//! Writes a page.

use std::fmt::Write as _;

use askama::Template;
use base64::Engine as _;
use base64::display::Base64Display;
use base64::engine::general_purpose::{GeneralPurpose, STANDARD};
use ndarray::Array2;
use serde::Serialize;

use super::View;
use crate::motion::group::DANCER_COLORS;
use crate::motion::{CHANNEL_NAMES, MOTION_DIM};
use crate::units::FPS;

const STYLE: &str = include_str!("page.css");
/// Parts of one script, in the order in which they build on each other.
const SCRIPTS: [&str; 5] = [
    include_str!("motion.js"),
    include_str!("stage.js"),
    include_str!("body.js"),
    include_str!("charts.js"),
    include_str!("page.js"),
];
/// The part that a page with a group has after them.
const GROUP_SCRIPT: &str = include_str!("group.js");
/// About how long the page is without scripts, style and data.
const OWN_BYTES: usize = 20 << 10;

/// The page. Every value is escaped but for those that the template marks as safe: files of this program, base64, and
/// JSON that [`inert`] went through.
#[derive(Template)]
#[template(path = "view/page.html")]
struct Page<'a> {
    title: &'a str,
    style: &'static str,
    audio: Option<EmbeddedAudio<'a>>,
    data: String,
    script: String,
}

struct EmbeddedAudio<'a> {
    mime: &'a str,
    base64: Base64Display<'a, 'static, GeneralPurpose>,
}

/// Returns the page as HTML. The same view gives the same text.
///
/// Whatever comes from outside is text there: no title, name or fact can become markup or script.
pub fn page(view: &View) -> String {
    let group_script = if has_group(view) { GROUP_SCRIPT } else { "" };
    let page = Page {
        title: &view.title,
        style: STYLE,
        audio: view.audio.as_ref().map(|audio| EmbeddedAudio {
            mime: &audio.mime,
            base64: Base64Display::new(&audio.bytes, &STANDARD),
        }),
        data: data(view),
        script: SCRIPTS.concat() + group_script,
    };
    let audio_bytes = view.audio.as_ref().map_or(0, |audio| audio.bytes.len().div_ceil(3) * 4);
    let n_bytes = audio_bytes + page.data.len() + page.script.len() + STYLE.len() + OWN_BYTES;
    let mut out = String::with_capacity(n_bytes);
    page.render_into(&mut out).expect("invariant: a string takes all that is written to it");
    out.push('\n');
    out
}

fn has_group(view: &View) -> bool {
    view.samples.iter().any(|sample| !sample.further_dancers.is_empty())
}

/// The data that the script reads.
#[derive(Serialize)]
struct Data<'a> {
    fps: f64,
    channels: [&'static str; MOTION_DIM],
    beats: Vec<f64>,
    samples: Vec<Sample<'a>>,
    /// Of dancers, `#rrggbb`, where there is a group.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    colors: Vec<String>,
}

#[derive(Serialize)]
struct Sample<'a> {
    name: &'a str,
    facts: &'a [(String, String)],
    frames: String,
    /// Of a group: the other dancers.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    dancers: Vec<String>,
}

/// Returns the data as JSON that can stand in a script element.
fn data(view: &View) -> String {
    let mut beats: Vec<f64> = view.beats_s.iter().copied().filter(|s| s.is_finite()).collect();
    beats.sort_by(f64::total_cmp);
    let samples = view.samples.iter().map(|sample| Sample {
        name: &sample.name,
        facts: &sample.facts,
        frames: floats(&sample.frames),
        dancers: sample.further_dancers.iter().map(floats).collect(),
    });
    let colors = if has_group(view) {
        DANCER_COLORS.map(|[r, g, b]| format!("#{r:02x}{g:02x}{b:02x}")).to_vec()
    } else {
        Vec::new()
    };
    let samples = samples.collect();
    let data = Data { fps: FPS, channels: CHANNEL_NAMES, beats, samples, colors };
    let json = serde_json::to_string(&data)
        .expect("invariant: the data hold only strings and finite numbers");
    inert(&json)
}

/// Returns numbers, row by row, as base64 of their little-endian bytes.
fn floats(frames: &Array2<f32>) -> String {
    debug_assert_eq!(frames.ncols(), MOTION_DIM, "channels of a motion");
    let bytes: Vec<u8> = frames.iter().flat_map(|value| value.to_le_bytes()).collect();
    STANDARD.encode(bytes)
}

/// Returns JSON with every sign escaped by which a string could end the script element around it, or
/// a line of script. These stand in strings alone, where JSON may write them so.
fn inert(json: &str) -> String {
    let mut out = String::with_capacity(json.len());
    for c in json.chars() {
        match c {
            '<' | '>' | '&' | '\u{2028}' | '\u{2029}' => {
                // A string takes all that is written to it.
                let _ = write!(out, "\\u{:04x}", u32::from(c));
            }
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::{Audio, ViewSample};
    use ndarray::Array3;
    use proptest::prelude::*;

    fn sample(name: &str, n_frames: usize) -> ViewSample {
        let frames = Array2::from_shape_fn((n_frames, MOTION_DIM), |(t, i)| {
            t as f32 + i as f32 / 32.0 - 1.5
        });
        let facts = vec![("seed".to_owned(), "7".to_owned())];
        ViewSample { name: name.to_owned(), frames, further_dancers: Vec::new(), facts }
    }

    fn view(title: &str, samples: Vec<ViewSample>) -> View {
        View { title: title.to_owned(), samples, beats_s: vec![0.5, 1.0], audio: None }
    }

    /// Returns what the script of a page reads.
    fn data_of(page: &str) -> serde_json::Value {
        let (_, rest) = page.split_once("id=\"data\">").expect("data");
        let (json, _) = rest.split_once("</script>").expect("the end of the data");
        serde_json::from_str(json).expect("JSON")
    }

    fn floats_of(base64: &serde_json::Value) -> Vec<f32> {
        let bytes = STANDARD.decode(base64.as_str().expect("text")).expect("base64");
        bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
    }

    #[test]
    fn every_slot_is_filled_and_every_script_is_there() {
        let page = page(&view("A walk", vec![sample("0", 3)]));
        assert!(!page.contains("{{") && !page.contains("{%") && page.ends_with("\n</html>\n"));
        assert!(page.starts_with("<!DOCTYPE html>\n<html lang=\"en\">\n"));
        assert!(page.contains("<title>A walk</title>") && page.contains("<h1>A walk</h1>"));
        for part in SCRIPTS {
            assert!(page.contains(part));
            // What would end the element that the script stands in.
            assert!(!part.contains("</script") && !part.contains("<!--"));
        }
        assert!(page.contains(STYLE) && !STYLE.contains("</style"));
        for name in ["motiongenReady", "window.motiongen = {", "frame:", "seek,", "play,", "pause,"]
        {
            assert!(page.contains(name), "no {name}");
        }
        assert!(!page.contains("<audio"));
    }

    #[test]
    fn a_group_has_its_dancers_and_the_part_that_draws_them() {
        let group = Array3::from_shape_fn((3, 4, MOTION_DIM), |(n, t, i)| {
            n as f32 * 8.0 + t as f32 + i as f32 / 32.0
        });
        let facts = vec![("dancers".to_owned(), "3".to_owned())];
        let trio = ViewSample::of_group("trio".to_owned(), group.view(), facts);
        let alone = page(&view("t", vec![sample("0", 3)]));
        assert!(!alone.contains(GROUP_SCRIPT) && !alone.contains("\"dancers\":["));
        let page = page(&view("t", vec![sample("0", 3), trio]));
        assert!(page.contains(GROUP_SCRIPT) && !GROUP_SCRIPT.contains("</script"));
        // It builds on what comes before.
        assert!(page.find(GROUP_SCRIPT) > page.find(SCRIPTS[4]));
        let data = data_of(&page);
        assert_eq!(data["samples"][0].get("dancers"), None);
        assert_eq!((&data["colors"][1], data_of(&alone).get("colors")), (&"#e69f00".into(), None));
        let dancers = &data["samples"][1]["dancers"];
        assert_eq!(dancers.as_array().map(Vec::len), Some(2));
        assert_eq!(floats_of(&data["samples"][1]["frames"])[25], 1.0);
        assert_eq!(floats_of(&dancers[1])[3 * 25 + 2], 16.0 + 3.0 + 2.0 / 32.0);
        let nobody = Array3::zeros((0, 4, MOTION_DIM));
        let nobody = ViewSample::of_group(String::new(), nobody.view(), Vec::new());
        assert_eq!((nobody.frames.dim(), nobody.further_dancers.len()), ((0, MOTION_DIM), 0));
    }

    #[test]
    fn nothing_is_asked_of_a_network() {
        let mut view = view("t", vec![sample("0", 3)]);
        view.audio = Some(Audio { mime: "audio/mpeg".to_owned(), bytes: vec![1, 2, 3] });
        let page = page(&view);
        for request in
            ["http://", "https://", "//cdn", "@import", "url(", "import(", "fetch(", "XMLHttp"]
        {
            assert!(!page.contains(request), "{request}");
        }
        // The only source is the embedded audio.
        let sources: Vec<&str> = page.split(" src=\"").skip(1).map(|rest| &rest[..16]).collect();
        assert_eq!(sources, ["data:audio/mpeg;"]);
        assert!(!page.contains(" href="));
    }

    #[test]
    fn numbers_are_there_bit_by_bit() {
        let mut broken = sample("b", 2);
        broken.frames[[1, 3]] = f32::NAN;
        broken.frames[[0, 24]] = f32::NEG_INFINITY;
        let mut view = view("t", vec![sample("a", 7), broken.clone()]);
        view.beats_s = vec![1.5, f64::NAN, 0.25, f64::INFINITY];
        let data = data_of(&page(&view));
        assert_eq!(data["fps"], 30.0);
        assert_eq!(data["channels"][9], "quaternion_w");
        assert_eq!(data["channels"].as_array().map(Vec::len), Some(25));
        assert_eq!(data["beats"], serde_json::json!([0.25, 1.5]));
        assert_eq!(data["samples"][0]["facts"], serde_json::json!([["seed", "7"]]));
        let found = floats_of(&data["samples"][0]["frames"]);
        assert_eq!(found.len(), 7 * 25);
        // Frame 6, channel 2: 6 + 2/32 - 1.5.
        assert_eq!(found[6 * 25 + 2], 4.5625);
        let found = floats_of(&data["samples"][1]["frames"]);
        assert!(found[25 + 3].is_nan());
        assert_eq!(found[24], f32::NEG_INFINITY);
        // The order of axes in memory does not matter.
        let turned = broken.frames.t().as_standard_layout().into_owned().reversed_axes();
        assert_eq!(floats(&turned), floats(&broken.frames));
    }

    #[test]
    fn text_from_outside_stays_text() {
        let hostile = "</script><script>alert('1')</script>\u{2028}\u{2029}<!-- \"&amp;";
        let mut bad = sample(hostile, 1);
        bad.facts = vec![(hostile.to_owned(), hostile.to_owned())];
        let mut view = view(hostile, vec![bad]);
        view.audio = Some(Audio { mime: "a\"><script>".to_owned(), bytes: Vec::new() });
        let page = page(&view);
        assert_eq!(page.matches("</script>").count(), 2, "of the data and of the script");
        assert_eq!(page.matches("<script").count(), 2);
        let title = "&lt;/script&gt;&lt;script&gt;alert(&#39;1&#39;)";
        assert_eq!(page.matches(title).count(), 2, "in title and heading");
        assert!(page.contains("src=\"data:a&quot;&gt;&lt;script&gt;;base64,\"></audio>"));
        let (_, json) = page.split_once("id=\"data\">").expect("data");
        let (json, _) = json.split_once("</script>").expect("its end");
        assert!(!json.contains(['<', '>', '&', '\u{2028}', '\u{2029}']));
        let data = data_of(&page);
        assert_eq!(data["samples"][0]["name"], hostile);
        assert_eq!(data["samples"][0]["facts"][0][1], hostile);
    }

    #[test]
    fn the_audio_is_a_data_uri() {
        // RFC 4648, section 10.
        let cases =
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")];
        for (bytes, base64) in cases {
            let mut view = view("t", vec![sample("0", 1)]);
            let bytes = bytes.as_bytes().to_vec();
            view.audio = Some(Audio { mime: "audio/ogg".to_owned(), bytes });
            let wanted = format!(
                "<audio id=\"audio\" preload=\"auto\" src=\"data:audio/ogg;base64,{base64}\"></audio>\n"
            );
            assert!(page(&view).contains(&wanted), "{base64}");
        }
    }

    #[test]
    fn a_page_without_motion_is_a_page() {
        let data = data_of(&page(&view("", Vec::new())));
        assert_eq!(data["samples"], serde_json::json!([]));
    }

    proptest! {
        #[test]
        fn names_are_read_back(name in any::<String>()) {
            let page = page(&view(&name, vec![sample(&name, 1)]));
            prop_assert_eq!(page.matches("</script>").count(), 2);
            let data = data_of(&page);
            prop_assert_eq!(data["samples"][0]["name"].as_str(), Some(name.as_str()));
        }
    }
}
