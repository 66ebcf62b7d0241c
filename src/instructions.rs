//! Which vector instructions this machine has, and loops compiled for each.
//!
//! Invariant of every `unsafe` call here: code for an instruction set runs only where [`level`] found it.

use std::sync::LazyLock;

/// The vector instructions in use, the widest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    Avx512,
    Avx2,
    /// What the target always has: NEON on 64-bit ARM, SSE2 on x86-64.
    Portable,
}

/// Returns the widest level that the machine has.
///
/// `MOTIONGEN_SIMD=avx2` or `portable` asks for less, to compare or to test.
pub fn level() -> Level {
    static LEVEL: LazyLock<Level> = LazyLock::new(|| {
        let asked = std::env::var("MOTIONGEN_SIMD").unwrap_or_default();
        detect(&asked)
    });
    *LEVEL
}

#[cfg(target_arch = "x86_64")]
fn detect(asked: &str) -> Level {
    let avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    let avx512 = avx2
        && ["avx512f", "avx512vl", "avx512bw", "avx512dq"].iter().all(|name| match *name {
            "avx512f" => is_x86_feature_detected!("avx512f"),
            "avx512vl" => is_x86_feature_detected!("avx512vl"),
            "avx512bw" => is_x86_feature_detected!("avx512bw"),
            _ => is_x86_feature_detected!("avx512dq"),
        });
    match asked {
        "portable" => Level::Portable,
        "avx2" if avx2 => Level::Avx2,
        _ if avx512 => Level::Avx512,
        _ if avx2 => Level::Avx2,
        _ => Level::Portable,
    }
}

#[cfg(not(target_arch = "x86_64"))]
fn detect(_asked: &str) -> Level {
    Level::Portable
}

/// Compiles a function for each level and calls the widest that the machine has.
///
/// The body is plain safe code; its loops become vector code. No product is fused with a sum, so
/// that all levels give the same bits. What the body calls is compiled along with it only where it is
/// inlined.
macro_rules! vectorized {
    ($(
        $(#[$meta:meta])*
        $vis:vis fn $name:ident $(<$E:ident: Element $(, $F:ident: $bound:path)?>)? (
            $($arg:ident: $type:ty),* $(,)?
        ) $(-> $result:ty)? $body:block
    )*) => {$(
        $(#[$meta])*
        #[allow(unsafe_code, reason = "calls code for instructions that were found on this machine")]
        $vis fn $name $(<$E: Element $(, $F: $bound)?>)? ($($arg: $type),*) $(-> $result)? {
            #[inline(always)]
            fn body $(<$E: Element $(, $F: $bound)?>)? ($($arg: $type),*) $(-> $result)? $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
                fn avx512 $(<$E: Element $(, $F: $bound)?>)? ($($arg: $type),*) $(-> $result)? {
                    body($($arg),*)
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2 $(<$E: Element $(, $F: $bound)?>)? ($($arg: $type),*) $(-> $result)? {
                    body($($arg),*)
                }
                use $crate::instructions::{Level, level};
                match level() {
                    // SAFETY: `level` found these instructions.
                    Level::Avx512 => return unsafe { avx512($($arg),*) },
                    // SAFETY: as above.
                    Level::Avx2 => return unsafe { avx2($($arg),*) },
                    Level::Portable => {}
                }
            }
            body($($arg),*)
        }
    )*};
}
pub(crate) use vectorized;
