//! Content digests: BLAKE3, in hexadecimal.
//!
//! Every byte that comes in is digested, so the digest must not cost more than reading: BLAKE3 runs
//! on SIMD instructions that every CPU has, where SHA-256 needs instructions that many lack (measured
//! at 170 MB/s without them). `b3sum` prints the same.

/// Returns the digest of bytes: 64 hexadecimal digits.
pub fn digest(bytes: &[u8]) -> String {
    blake3::hash(bytes).to_hex().to_string()
}

/// Returns the digest of everything left in a reader.
///
/// # Errors
/// The error of the reader.
pub fn digest_of(reader: &mut impl std::io::Read) -> std::io::Result<String> {
    let mut hasher = blake3::Hasher::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        match reader.read(&mut buffer)? {
            0 => return Ok(hasher.finalize().to_hex().to_string()),
            n => hasher.update(&buffer[..n]),
        };
    }
}

/// Returns the digest of a sequence of texts, such that no two different sequences run together.
pub fn digest_texts<'a>(texts: impl IntoIterator<Item = &'a str>) -> String {
    let mut hasher = blake3::Hasher::new();
    for text in texts {
        hasher.update(&(text.len() as u64).to_le_bytes());
        hasher.update(text.as_bytes());
    }
    hasher.finalize().to_hex().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digests_are_those_of_the_blake3_specification() {
        // test_vectors.json of the BLAKE3 repository: input bytes 0, 1, …, 250, 0, …; lengths 0 and 3.
        let empty = "af1349b9f5f9a1a6a0404dea36dcc9499bcb25c9adc112b7cc9a93cae41f3262";
        assert_eq!(digest(b""), empty);
        let three = "e1be4d7a8ab5560aa4199eea339849ba8e293d55ca0a81006726d184519e647f";
        assert_eq!(digest(&[0, 1, 2]), three);
        assert_eq!(digest_of(&mut [0_u8, 1, 2].as_slice()).expect("a slice is readable"), three);
    }

    #[test]
    fn sequences_do_not_run_together() {
        assert_ne!(digest_texts(["ab", "c"]), digest_texts(["a", "bc"]));
        assert_ne!(digest_texts(["a"]), digest_texts(["a", ""]));
    }
}
