//! The `library` field of a log's first record: which program wrote the log.

use std::io::BufReader;

use crate::records::Records;
use crate::source::LogSource;

/// Library of a log that Trabecula recorded, or rewrote from its own recordings: the header's metadata
/// precede the first message.
pub(crate) const LIBRARY: &str = concat!("trabecula ", env!("CARGO_PKG_VERSION"));
/// Library of a rewritten log of another program: metadata are where that program put them.
const REWRITTEN: &str = concat!("rewritten by trabecula ", env!("CARGO_PKG_VERSION"));

/// Returns whether a header's library names the recorder, of any version.
pub(crate) fn is_ours(library: &str) -> bool {
    library.starts_with("trabecula ")
}

/// Returns the library for a log that is rewritten from the records of others.
pub(crate) fn of_rewritten(inputs: &[&dyn LogSource]) -> &'static str {
    if inputs.iter().any(|input| is_by_another(*input)) { REWRITTEN } else { LIBRARY }
}

/// Returns whether an input names another program; false if it cannot be read far enough.
fn is_by_another(input: &dyn LogSource) -> bool {
    let Ok(source) = input.open() else { return false };
    let Ok(mut records) = Records::new(BufReader::new(source), input.path()) else { return false };
    // Every record returned comes after the header record.
    let _ = records.next_record();
    records.is_written_by_another()
}
