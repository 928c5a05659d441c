//! gzip streams as stored in files: consecutive members, then zero padding.

use flate2::bufread::GzDecoder;
use std::io::{self, BufRead, Read};

/// Decodes every member of a gzip stream. Zero bytes after the last member are padding, as for `gzip(1)`;
/// anything else there is an error.
pub(crate) struct GzipMembers<R> {
    state: State<R>,
}

enum State<R> {
    Member(Box<GzDecoder<R>>),
    Ended,
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
            let State::Member(decoder) = std::mem::replace(&mut self.state, State::Ended) else {
                return Ok(0);
            };
            let mut rest = decoder.into_inner();
            let padded = skip_zeros(&mut rest)?;
            match rest.fill_buf()?.first() {
                None => return Ok(0),
                Some(0x1f) if !padded => {
                    self.state = State::Member(Box::new(GzDecoder::new(rest)));
                }
                Some(_) => {
                    return Err(io::Error::new(
                        io::ErrorKind::InvalidData,
                        "trailing bytes that are not gzip data",
                    ));
                }
            }
        }
    }
}

/// Skips zero bytes; returns whether there were any.
fn skip_zeros(reader: &mut impl BufRead) -> io::Result<bool> {
    let mut any = false;
    loop {
        let buffer = reader.fill_buf()?;
        let zeros = buffer.iter().take_while(|byte| **byte == 0).count();
        let all = zeros == buffer.len();
        if zeros == 0 {
            return Ok(any);
        }
        any = true;
        reader.consume(zeros);
        if !all {
            return Ok(any);
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
    fn members_are_joined_and_zero_padding_is_passed_over() {
        assert_eq!(decoded(&[member(b"ab"), member(b"cd")].concat()).unwrap(), b"abcd");
        assert_eq!(decoded(&[member(b"ab"), vec![0; 512]].concat()).unwrap(), b"ab");
        for wrong in [b"x".to_vec(), [vec![0; 9], b"x".to_vec()].concat()] {
            assert!(decoded(&[member(b"ab"), wrong].concat()).is_err());
        }
    }
}
