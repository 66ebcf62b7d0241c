//! The frames of MPEG audio layer III decoded.
//!
//! Follows minimp3 (CC0) as nanomp3-core (© 2025 Robert B. Langer, MIT, see `layer3/LICENSE-MIT`)
//! has it in Rust, expression by expression, with two exceptions, for which libmpg123 is followed. Short blocks are brought in
//! order before channels are added: the blocks of two channels may be laid out differently. And
//! the end of a block has its own window, not that of the next block: they differ where a mixed
//! block follows another one. Symphonia's decoder refuses the former and gives mixed blocks the
//! wrong gain.
//!
//! ISO/IEC 11172-3 section 2.4 and ISO/IEC 13818-3.

#![allow(
    clippy::excessive_precision,
    clippy::needless_range_loop,
    reason = "expressions and tables stay comparable with minimp3's"
)]

mod codes;
mod huffman;
mod hybrid;
mod lanes;
mod side_info;
mod stereo;
mod synthesis;
mod tables;

use side_info::{Bits, Granule, Header};
use synthesis::SYN_ROWS;

/// Bytes that a frame may take from those before it: 9 bits count them.
const MAX_RESERVOIR_BYTES: usize = 511;

/// Samples of a frame, both channels.
pub(super) const MAX_FRAME_SAMPLES: usize = 1152 * 2;

/// Why a frame was not decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fault {
    /// Its side information breaks the format's rules.
    SideInfo,
    /// It needs bytes of frames that are not there, as the first frames of a cut do.
    Reservoir,
}

/// A decoder: what one frame leaves for the next, and room to work in.
pub(super) struct Layer3 {
    /// The ends of the blocks before, in their windows.
    overlap: [[f32; 576]; 2],
    filter: [f32; 960],
    reservoir: Vec<u8>,
    main_data: Vec<u8>,
    spectra: [[f32; 576]; 2],
    gains: [f32; 40],
    positions: [[u8; 39]; 2],
    rows: [[f32; 4]; SYN_ROWS],
}

impl Layer3 {
    pub fn new() -> Self {
        Self {
            overlap: [[0.0; 576]; 2],
            filter: [0.0; 960],
            reservoir: Vec::new(),
            main_data: Vec::new(),
            spectra: [[0.0; 576]; 2],
            gains: [0.0; 40],
            positions: [[0; 39]; 2],
            rows: [[0.0; 4]; SYN_ROWS],
        }
    }

    /// Decodes a whole frame of layer III into `pcm`, channels interleaved, which has the frame's
    /// number of samples; leaves `pcm` as it is on an error.
    pub fn decode(&mut self, frame: &[u8], pcm: &mut [f32]) -> Result<(), Fault> {
        let Some((&bytes, body)) = frame.split_first_chunk::<4>() else {
            return Err(Fault::SideInfo);
        };
        let header = Header(bytes);
        let n_channels = if header.is_mono() { 1 } else { 2 };
        let mut bits = Bits::new(body, body.len() as i32);
        if header.has_checksum() {
            bits.get_bits(16);
        }
        let mut granules = [Granule::default(); 4];
        let side_info = side_info::read_side_info(&mut bits, &mut granules, header);
        let main_data_start = match (header.is_mpeg_1(), header.is_mono()) {
            (true, false) => 32,
            (true, true) | (false, false) => 17,
            (false, true) => 9,
        };
        let start = main_data_start + if header.has_checksum() { 2 } else { 0 };
        let own = body.get(start..).unwrap_or_default();
        let Ok(n_before) = usize::try_from(side_info) else {
            self.keep(own);
            return Err(Fault::SideInfo);
        };
        self.main_data.clear();
        let n_known = self.reservoir.len();
        self.main_data.extend_from_slice(&self.reservoir[n_known - n_before.min(n_known)..]);
        self.main_data.extend_from_slice(own);
        if n_before > n_known {
            self.keep(own);
            return Err(Fault::Reservoir);
        }
        self.gains = [0.0; 40];
        self.positions = [[0; 39]; 2];
        let main_data = std::mem::take(&mut self.main_data);
        let mut bits = Bits::new(&main_data, main_data.len() as i32);
        let n_granules = if header.is_mpeg_1() { 2 } else { 1 };
        let parts = pcm.chunks_exact_mut(576 * n_channels).take(n_granules);
        for (part, granules) in parts.zip(granules.chunks(n_channels)) {
            self.spectra = [[0.0; 576]; 2];
            self.decode_granule(header, &mut bits, granules, n_channels);
            let Self { filter, spectra, rows, .. } = self;
            synthesis::synthesize_granule(filter, spectra, n_channels, part, rows);
        }
        self.main_data = main_data;
        self.keep(own);
        Ok(())
    }

    /// Keeps the end of the main data for the next frames.
    fn keep(&mut self, own: &[u8]) {
        self.reservoir.extend_from_slice(own);
        let n_over = self.reservoir.len().saturating_sub(MAX_RESERVOIR_BYTES);
        self.reservoir.drain(..n_over);
    }

    fn decode_granule(
        &mut self,
        header: Header,
        bits: &mut Bits<'_>,
        granules: &[Granule],
        n_channels: usize,
    ) {
        for ch in 0..n_channels {
            let (granule, positions) = (&granules[ch], &mut self.positions[ch]);
            let end = bits.pos + i32::from(granule.part_23_length);
            side_info::decode_scale_factors(header, positions, bits, granule, &mut self.gains, ch);
            huffman::decode_spectrum(&mut self.spectra[ch], bits, granule, &self.gains, end);
        }
        // Ratios are per band, so they come first; sums and differences are per line.
        if header.has_intensity() {
            let Some(both) = both(&mut self.spectra) else { return };
            stereo::intensity(both, &mut self.positions[1], granules, header);
        }
        for ch in 0..n_channels {
            self.reorder(header, &granules[ch], ch);
        }
        if header.has_mid_side()
            && !header.has_intensity()
            && let Some(both) = both(&mut self.spectra)
        {
            stereo::mid_side(both, 0, 576);
        }
        for ch in 0..n_channels {
            let granule = &granules[ch];
            let n_long = n_long_subbands(header, granule);
            let n_butterflies =
                if granule.n_short_sfb == 0 { 31 } else { n_long.saturating_sub(1) };
            hybrid::antialias(&mut self.spectra[ch], n_butterflies);
            hybrid::imdct(&mut self.spectra[ch], &mut self.overlap[ch], granule.block_type, n_long);
            hybrid::invert_odd(&mut self.spectra[ch]);
        }
    }

    fn reorder(&mut self, header: Header, granule: &Granule, ch: usize) {
        if granule.n_short_sfb == 0 {
            return;
        }
        let start = 18 * n_long_subbands(header, granule);
        let bands = &granule.sfbtab[usize::from(granule.n_long_sfb)..];
        hybrid::reorder(&mut self.spectra[ch][start..], self.rows.as_flattened_mut(), bands);
    }
}

/// The two spectra, one behind the other.
fn both(spectra: &mut [[f32; 576]; 2]) -> Option<&mut [f32; 1152]> {
    spectra.as_flattened_mut().try_into().ok()
}

/// Subbands with the transform and window of long blocks in a mixed block: two, four at 8 kHz.
fn n_long_subbands(header: Header, granule: &Granule) -> usize {
    if granule.mixed_block_flag == 0 {
        return 0;
    }
    2 << u32::from(header.rate_index() == 2)
}
