//! Huffman decoding and requantization (ISO/IEC 11172-3 section 2.4.3.4).

use super::codes::{LINBITS, PAIR_CODE_STARTS, PAIR_CODES, POW_4_3, QUAD_CODES_A, QUAD_CODES_B};
use super::side_info::{Bits, Granule};

fn pow_4_3(mut x: i32) -> f32 {
    let mut mult = 256;
    if x < 129 {
        return POW_4_3[(16 + x) as usize];
    }
    if x < 1024 {
        mult = 16;
        x <<= 3;
    }
    let sign = (2 * x) & 64;
    let frac = ((x & 63) - sign) as f32 / ((x & !63) + sign) as f32;
    POW_4_3[(16 + ((x + sign) >> 6)) as usize]
        * (1.0 + frac * ((4.0 / 3.0) + frac * (2.0 / 9.0)))
        * mult as f32
}

/// The next bits of the main data, the first one highest. Bytes past the end of the buffer read as
/// zero: a corrupt `big_values` can make the decoder run past the granule's data, which C tolerates
/// by reading neighbouring memory.
struct BitCache<'a> {
    buf: &'a [u8],
    /// The first byte that is not whole in the cache.
    next: usize,
    cache: u64,
    /// Bits of the cache that are in use; those below may be right already.
    n_bits: u32,
}

impl<'a> BitCache<'a> {
    /// Starts at a bit of the buffer.
    fn new(buf: &'a [u8], pos: i32) -> Self {
        let mut bits = Self { buf, next: (pos / 8) as usize, cache: 0, n_bits: 0 };
        bits.check();
        bits.flush(pos & 7);
        bits
    }

    #[inline(always)]
    fn peek(&self, n: i32) -> u32 {
        (self.cache >> (64 - n)) as u32
    }

    #[inline(always)]
    fn is_negative(&self) -> bool {
        self.cache.cast_signed() < 0
    }

    #[inline(always)]
    fn flush(&mut self, n: i32) {
        self.cache <<= n;
        self.n_bits = self.n_bits.wrapping_sub(n.cast_unsigned());
    }

    /// Fills the cache with 56 bits or more; a pair takes at most 19 + 2 · (13 + 1), and a start 7.
    #[inline(always)]
    fn check(&mut self) {
        let rest = self.buf.get(self.next..).unwrap_or_default();
        let bytes = match rest.first_chunk() {
            Some(bytes) => *bytes,
            None => std::array::from_fn(|i| rest.get(i).copied().unwrap_or(0)),
        };
        // What is there already is the same bits.
        self.cache |= u64::from_be_bytes(bytes) >> self.n_bits;
        self.next += ((63 - self.n_bits) / 8) as usize;
        self.n_bits |= 56;
    }

    /// Current bit position in the buffer.
    fn pos(&self) -> i32 {
        self.next as i32 * 8 - self.n_bits.cast_signed()
    }
}

/// Decodes Huffman pairs for one scalefactor band of the big-values region.
#[inline(always)]
fn decode_pairs<const LINBITS: bool>(
    out: &mut [f32],
    br: &mut BitCache,
    codebook: &[i16],
    linbits: i32,
    one: f32,
) {
    for pair in out.as_chunks_mut::<2>().0 {
        let mut w = 5;
        let mut leaf = i32::from(codebook[br.peek(w) as usize]);
        while leaf < 0 {
            br.flush(w);
            w = leaf & 7;
            leaf = i32::from(codebook[br.peek(w).wrapping_sub((leaf >> 3) as u32) as usize]);
        }
        br.flush(leaf >> 8);

        for v in pair {
            let mut lsb = leaf & 0x0F;
            if LINBITS && lsb == 15 {
                lsb += br.peek(linbits) as i32;
                br.flush(linbits);
                *v = one * pow_4_3(lsb) * if br.is_negative() { -1.0 } else { 1.0 };
            } else {
                *v = POW_4_3[(16 + lsb) as usize - 16 * (br.cache >> 63) as usize] * one;
            }
            br.flush((lsb != 0) as i32);
            leaf >>= 4;
        }
        br.check();
    }
}

pub(super) fn decode_spectrum(
    dst: &mut [f32; 576],
    bs: &mut Bits,
    granule: &Granule,
    scf: &[f32; 40],
    layer3gr_limit: i32,
) {
    let mut one = 0.0f32;
    let mut ireg = 0;
    let mut big_val_cnt = i32::from(granule.big_values);
    let sfbtab = granule.sfbtab;
    let mut sfb = 0;
    let mut scf_idx = 0;
    let mut d = 0;

    let mut br = BitCache::new(bs.buf, bs.pos);

    while big_val_cnt > 0 {
        let tab_num = granule.table_select[ireg] as usize;
        let mut sfb_cnt = i32::from(granule.region_count[ireg]);
        ireg += 1;
        let codebook = &PAIR_CODES[PAIR_CODE_STARTS[tab_num] as usize..];
        let linbits = i32::from(LINBITS[tab_num]);
        loop {
            let np = i32::from(sfbtab[sfb]) / 2;
            sfb += 1;
            let pairs_to_decode = big_val_cnt.min(np) as usize;
            one = scf[scf_idx];
            scf_idx += 1;
            // C's do/while always decodes at least one pair; np is never 0 here
            // because big_values <= 288 and every table covers 288 pairs.
            let out = &mut dst[d..d + 2 * pairs_to_decode.max(1)];
            if linbits != 0 {
                decode_pairs::<true>(out, &mut br, codebook, linbits, one);
            } else {
                decode_pairs::<false>(out, &mut br, codebook, linbits, one);
            }
            d += out.len();
            big_val_cnt -= np;
            if big_val_cnt <= 0 {
                break;
            }
            sfb_cnt -= 1;
            if sfb_cnt < 0 {
                break;
            }
        }
    }

    let codebook_count1: &[u8] =
        if granule.count1_table != 0 { &QUAD_CODES_B } else { &QUAD_CODES_A };
    let mut np = 1 - big_val_cnt;
    'count1: loop {
        let mut leaf = i32::from(codebook_count1[br.peek(4) as usize]);
        if leaf & 8 == 0 {
            leaf = i32::from(
                codebook_count1
                    [(leaf >> 3) as usize + (br.cache << 4 >> (64 - (leaf & 3))) as usize],
            );
        }
        br.flush(leaf & 7);
        if br.pos() > layer3gr_limit {
            break;
        }
        for half in 0..2 {
            np -= 1;
            if np == 0 {
                np = i32::from(sfbtab[sfb]) / 2;
                sfb += 1;
                if np == 0 {
                    break 'count1;
                }
                one = scf[scf_idx];
                scf_idx += 1;
            }
            for s in 2 * half..2 * half + 2 {
                if leaf & (128 >> s) != 0 {
                    dst[d + s] = if br.is_negative() { -one } else { one };
                    br.flush(1);
                }
            }
        }
        br.check();
        d += 4;
    }
    bs.pos = layer3gr_limit;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_come_in_order_and_are_zeros_behind_the_end() {
        let buf: Vec<u8> = (0..23).map(|i: u8| i.wrapping_mul(89).wrapping_add(41)).collect();
        let bit = |at: usize| buf.get(at / 8).map_or(0, |byte| u32::from(byte >> (7 - at % 8)) & 1);
        for start in [0, 3, 8, 21] {
            let mut bits = BitCache::new(&buf, start);
            let mut at = start as usize;
            // Pairs of codes and signs, up to the most that a pair takes.
            for (i, n) in [5, 1, 19, 13, 1, 7, 2, 4, 11, 6].into_iter().cycle().take(40).enumerate()
            {
                if i % 3 == 0 {
                    bits.check();
                }
                assert_eq!(bits.pos(), at as i32);
                let expected = (at..at + n).fold(0, |value, at| 2 * value + bit(at));
                assert_eq!(bits.peek(n as i32), expected, "{n} bits at {at}");
                assert_eq!(bits.is_negative(), bit(at) == 1);
                bits.flush(n as i32);
                at += n;
            }
        }
    }
}
