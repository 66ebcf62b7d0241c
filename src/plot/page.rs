//! What is on the page of a plot of features: title, facts, panels, ticks.

use ndarray::s;

use super::axis::TimeAxis;
use super::features::FeaturesPlot;
use super::header::{self, Fact};
use super::heatmap::{self, ColorScale};
use super::panel::Panel;
use super::scene::{Anchor, Rect, Scene};
use super::style::{
    AXIS, CAP_HEIGHT, HAIRLINE_PX, INK, MARGIN_PX, MISSING, TEXT_PX, TICK_GAP_PX, TICK_PX,
    VERMILLION,
};
use super::{curve, frame};
use crate::units::{FPS, frames_to_s};

/// Beats closer than this on average are not drawn: they would be a veil.
const MIN_BEAT_GAP_PX: f64 = 5.0;

/// Frequencies on the mel axis in Hz, those first whose label matters most.
const MEL_TICKS_HZ: [u32; 6] = [1000, 100, 5000, 500, 2000, 200];
/// Pitch classes, as chroma orders them.
const NOTES: [&str; 12] = ["C", "C♯", "D", "D♯", "E", "F", "F♯", "G", "G♯", "A", "A♯", "B"];

/// The beats on the page.
struct Beats {
    n_beats: usize,
    /// Where they are; empty if they are too close.
    x: Vec<f64>,
}

fn beats(plot: &FeaturesPlot<'_>, time: &TimeAxis) -> Beats {
    let half_frame_s = 0.5 / FPS;
    let shown = time.start_s - half_frame_s..time.end_s() + half_frame_s;
    let is_shown = |s: &&f64| time.n_frames > 0 && shown.contains(*s);
    let x: Vec<_> = plot.beat_times_s.iter().filter(is_shown).map(|&s| time.x(s)).collect();
    let n_beats = x.len();
    let fits = n_beats as f64 * MIN_BEAT_GAP_PX <= time.width;
    Beats { n_beats, x: if fits { x } else { Vec::new() } }
}

/// A plot in the making.
pub(super) struct Page {
    scene: Scene,
    time: TimeAxis,
    beats: Beats,
}

impl Page {
    pub fn new(plot: &FeaturesPlot<'_>, time: TimeAxis) -> Self {
        let title = plot.title.to_owned();
        let scene = Scene { width_px: 0.0, height_px: 0.0, title, items: Vec::new() };
        Self { scene, time, beats: beats(plot, &time) }
    }

    /// Ends the page below a last panel that ends at `bottom`.
    pub fn into_scene(mut self, width_px: f64, bottom: f64) -> Scene {
        self.scene.width_px = width_px;
        self.scene.height_px = bottom + frame::X_TITLE_PX + MARGIN_PX;
        self.scene
    }

    /// Writes the title and, below it, as many facts as there is room for.
    pub fn header(&mut self, plot: &FeaturesPlot<'_>, panels: &[Panel]) {
        let (left, right) = (self.time.left, self.time.right());
        header::title(&mut self.scene, left, right, plot.title);
        let facts = self.facts(plot, panels);
        header::facts(&mut self.scene, left, right, header::FACTS_BASE_PX, facts, 1);
    }

    fn facts(&self, plot: &FeaturesPlot<'_>, panels: &[Panel]) -> Vec<Fact> {
        let n_frames = plot.values.nrows();
        let counted = |n: usize, one: &str| header::counted(n as u64, one);
        let duration_s = frames_to_s(n_frames);
        let decimals = if duration_s < 1000.0 { 2 } else { 0 };
        let mut facts = vec![
            Fact::plain(format!("{duration_s:.decimals$} s")),
            Fact::plain(format!("{} at {FPS} fps", counted(n_frames, "frame"))),
        ];
        if let Some(tempo) = plot.tempo_bpm.filter(|t| t.is_finite() && *t > 0.0) {
            facts.push(Fact::plain(format!("{tempo:.1} bpm")));
        }
        let n_beats = self.beats.n_beats;
        facts.push(if n_beats > 0 && self.beats.x.is_empty() {
            Fact::plain(format!("{n_beats} beats, too close to draw"))
        } else {
            let key = (n_beats > 0).then_some((VERMILLION, HAIRLINE_PX * 1.5));
            Fact { key, text: counted(n_beats, "beat") }
        });
        let n_missing: usize = panels
            .iter()
            .map(|panel| plot.values.slice(s![.., panel.columns()]))
            .map(|values| values.iter().filter(|v| !v.is_finite()).count())
            .sum();
        if n_missing > 0 {
            let text = format!("{} not finite", counted(n_missing, "value"));
            facts.push(Fact { key: Some((MISSING, TICK_PX)), text });
        }
        let width_px = self.time.width;
        let n_columns = heatmap::n_columns(n_frames, width_px);
        if n_columns < n_frames && panels.iter().any(|p| p.is_heat_map()) {
            let n = n_frames as f64 / n_columns as f64;
            facts.push(Fact::plain(format!("columns: means of {n:.1} frames")));
        }
        let n_columns = curve::n_columns(n_frames, width_px);
        if n_columns < n_frames && panels.iter().any(|p| !p.is_heat_map()) {
            let n = n_frames as f64 / n_columns as f64;
            facts.push(Fact::plain(format!("curves: mean and range of {n:.0} frames")));
        }
        facts
    }

    pub fn panel(&mut self, panel: Panel, rect: Rect, plot: &FeaturesPlot<'_>) {
        self.heading(panel, rect);
        let values = plot.values.slice(s![.., panel.columns()]);
        match panel {
            Panel::Mel | Panel::Chroma => {
                heatmap::draw(&mut self.scene, rect, values, ColorScale::Amount);
            }
            Panel::Mfcc => heatmap::draw(&mut self.scene, rect, values, ColorScale::Deviation),
            Panel::Rms | Panel::SpectralCentroid | Panel::OnsetStrength => {
                let marks = match panel {
                    Panel::OnsetStrength => self.beats.x.as_slice(),
                    _ => &[],
                };
                curve::draw(&mut self.scene, rect, values.column(0), &self.time, marks);
            }
        }
        match panel {
            Panel::Mel => self.mel_ticks(rect, plot.mel_hz),
            Panel::Chroma => {
                for (i, note) in NOTES.into_iter().enumerate() {
                    self.row_label(rect, (i as f64 + 0.5) / 12.0, note);
                }
            }
            Panel::Mfcc => {
                for i in (0..20).step_by(5) {
                    self.row_label(rect, (f64::from(i) + 0.5) / 20.0, &i.to_string());
                }
            }
            Panel::Rms | Panel::SpectralCentroid | Panel::OnsetStrength => {}
        }
        if panel != Panel::OnsetStrength {
            for &x in &self.beats.x {
                let top = rect.top - TICK_PX - HAIRLINE_PX;
                self.scene.vertical(x, top, rect.top - HAIRLINE_PX, HAIRLINE_PX, VERMILLION);
            }
        }
        self.time_ticks(rect.bottom());
    }

    fn heading(&mut self, panel: Panel, rect: Rect) {
        let unit = match panel {
            Panel::Mel => "Hz",
            Panel::Mfcc => "no.",
            _ => "",
        };
        let right = self.time.right();
        frame::heading(&mut self.scene, rect, right, panel.heading(), &panel.meanings(), unit);
    }

    /// Puts a tick at each frequency, and its label where it does not touch one that is there.
    fn mel_ticks(&mut self, rect: Rect, mel_hz: &[f64]) {
        let mut labelled: Vec<f64> = Vec::new();
        for hz in MEL_TICKS_HZ {
            let Some(row) = row_of(f64::from(hz), mel_hz) else { continue };
            let up = (row + 0.5) / mel_hz.len() as f64;
            let is_free = labelled.iter().all(|&l| (l - up).abs() * rect.height >= TEXT_PX * 0.9);
            self.row_label(rect, up, &if is_free { hz.to_string() } else { String::new() });
            if is_free {
                labelled.push(up);
            }
        }
    }

    /// Puts a tick and a label at the left of a panel, `up` of its height (0 to 1) above its foot.
    fn row_label(&mut self, rect: Rect, up: f64, label: &str) {
        let y = ((rect.bottom() - up * rect.height) * 2.0).round() / 2.0;
        let right = rect.left - HAIRLINE_PX;
        let top = y - HAIRLINE_PX / 2.0;
        self.scene.horizontal(right - TICK_PX, right, top, HAIRLINE_PX, AXIS);
        let at = [rect.left - TICK_PX - TICK_GAP_PX, y + CAP_HEIGHT * TEXT_PX / 2.0];
        self.scene.text(at, Anchor::End, label, TEXT_PX, INK);
    }

    fn time_ticks(&mut self, bottom: f64) {
        let ticks = self.time.ticks();
        let x = ticks.iter().map(|tick| self.time.x(tick.value));
        frame::x_ticks(&mut self.scene, x, bottom);
    }

    pub fn time_labels(&mut self, bottom: f64) {
        let (time, ticks) = (self.time, self.time.ticks());
        let labels = ticks.iter().map(|tick| (time.x(tick.value), tick.label.as_str()));
        frame::x_labels(&mut self.scene, labels, [time.left, time.right()], bottom, "time (s)");
    }
}

/// Returns the row, with a fraction, whose centre frequency is `hz`; `None` beyond the bands.
fn row_of(hz: f64, mel_hz: &[f64]) -> Option<f64> {
    let above = mel_hz.partition_point(|&center| center < hz);
    if above == 0 || above >= mel_hz.len() {
        return None;
    }
    let (low, high) = (mel_hz[above - 1], mel_hz[above]);
    Some((above - 1) as f64 + (hz - low) / (high - low))
}
