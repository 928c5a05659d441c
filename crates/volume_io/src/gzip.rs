//! gzip streams as stored in files: consecutive members, then padding.

use crate::input::Stream;
use flate2::bufread::GzDecoder;
use std::io::{self, BufRead, Read};

/// Decodes every member of a gzip stream. What follows the last member is ignored, as by `gzip(1)`, and
/// reported by [`Stream::has_more`]: readers notice if a volume lacks a part of its bytes.
pub(crate) struct GzipMembers<R> {
    state: State<R>,
}

enum State<R> {
    Member(Box<GzDecoder<R>>),
    /// The source, after the last member.
    Ended(R),
    /// The source failed between members.
    Failed,
}

impl<R: BufRead> GzipMembers<R> {
    pub fn new(reader: R) -> Self {
        Self { state: State::Member(Box::new(GzDecoder::new(reader))) }
    }
}

impl<R: BufRead> Read for GzipMembers<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        loop {
            let State::Member(decoder) = &mut self.state else { return Ok(0) };
            let got = decoder.read(buffer)?;
            if got > 0 || buffer.is_empty() {
                return Ok(got);
            }
            let State::Member(decoder) = std::mem::replace(&mut self.state, State::Failed) else {
                return Ok(0);
            };
            let mut rest = decoder.into_inner();
            if rest.fill_buf()?.first() != Some(&0x1f) {
                self.state = State::Ended(rest);
                return Ok(0);
            }
            self.state = State::Member(Box::new(GzDecoder::new(rest)));
        }
    }
}

impl<R: BufRead> Stream for GzipMembers<R> {
    /// Zeros are padding, as on tapes.
    fn has_more(&mut self) -> io::Result<bool> {
        let State::Ended(rest) = &mut self.state else { return Ok(false) };
        loop {
            let bytes = rest.fill_buf()?;
            let length = bytes.len();
            if length == 0 || bytes.iter().any(|byte| *byte != 0) {
                return Ok(length > 0);
            }
            rest.consume(length);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn member(text: &[u8]) -> Vec<u8> {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(text).unwrap();
        encoder.finish().unwrap()
    }

    fn decoded(bytes: &[u8]) -> io::Result<Vec<u8>> {
        let mut out = Vec::new();
        GzipMembers::new(io::BufReader::with_capacity(7, bytes)).read_to_end(&mut out).map(|_| out)
    }

    #[test]
    fn members_are_joined_and_trailing_bytes_are_passed_over() {
        assert_eq!(decoded(&[member(b"ab"), member(b"cd")].concat()).unwrap(), b"abcd");
        assert_eq!(decoded(&[member(b"ab"), vec![0; 512]].concat()).unwrap(), b"ab");
        // Regression: other bytes were an error.
        for rest in [b"x".to_vec(), [vec![0; 9], b"x".to_vec()].concat()] {
            assert_eq!(decoded(&[member(b"ab"), rest].concat()).unwrap(), b"ab");
        }
        assert!(decoded(&[member(b"ab"), b"\x1fx".to_vec()].concat()).is_err());
    }
}
