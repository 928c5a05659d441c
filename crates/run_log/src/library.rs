//! What a log's first record says of the program that wrote it.

use std::io::BufReader;

use crate::records::Records;
use crate::source::LogSource;

/// The program that recorded a log, or wrote again what it had recorded: the header's metadata stand before
/// the first message.
pub(crate) const LIBRARY: &str = concat!("trabecula ", env!("CARGO_PKG_VERSION"));
/// What wrote a log of another program again: metadata stand where that program put them.
const REWRITTEN: &str = concat!("rewritten by trabecula ", env!("CARGO_PKG_VERSION"));

/// Whether a file's header names the recorder, of any version.
pub(crate) fn is_ours(library: &str) -> bool {
    library.starts_with("trabecula ")
}

/// The name for a log that is written from the records of others.
pub(crate) fn of_rewritten(inputs: &[&dyn LogSource]) -> &'static str {
    if inputs.iter().any(|input| is_by_another(*input)) { REWRITTEN } else { LIBRARY }
}

/// Whether an input names another program; one that cannot be read so far names none.
fn is_by_another(input: &dyn LogSource) -> bool {
    let Ok(source) = input.open() else { return false };
    let Ok(mut records) = Records::new(BufReader::new(source), input.path()) else { return false };
    // The header record stands before whatever this returns.
    let _ = records.next_record();
    records.is_written_by_another()
}
