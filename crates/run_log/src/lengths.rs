//! Checks that all strings lie within a record before it is parsed. The `mcap` crate's parser allocates
//! memory as soon as it has read a string's length: up to 4 GiB for a record of a few bytes. Format:
//! <https://mcap.dev/spec>, "Records".

use mcap::records::{Record, op};

/// A part of a record's body.
#[derive(Clone, Copy)]
enum BodyField {
    /// A fixed number of bytes.
    Fixed(usize),
    /// A length-prefixed string.
    Text,
    /// Pairs of strings, prefixed by their total length.
    Texts,
    /// Numbers, prefixed by their total length.
    Numbers,
}

/// Returns a record's parts up to its last string; empty for records without strings.
fn parts(opcode: u8) -> &'static [BodyField] {
    use BodyField::{Fixed, Numbers, Text, Texts};
    match opcode {
        op::HEADER => &[Text, Text],
        op::SCHEMA => &[Fixed(2), Text, Text],
        op::CHANNEL => &[Fixed(4), Text, Text, Texts],
        op::CHUNK => &[Fixed(28), Text],
        op::CHUNK_INDEX => &[Fixed(32), Numbers, Fixed(8), Text],
        op::ATTACHMENT_INDEX => &[Fixed(40), Text, Text],
        op::METADATA => &[Text, Texts],
        op::METADATA_INDEX => &[Fixed(16), Text],
        _ => &[],
    }
}

/// Splits off a length-prefixed part.
fn counted(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_first_chunk()?;
    rest.split_at_checked(u32::from_le_bytes(*length) as usize)
}

/// Checks that every string lies within the body; `None` if one does not.
fn texts_fit(opcode: u8, body: &[u8]) -> Option<()> {
    let mut rest = body;
    for part in parts(opcode) {
        rest = match part {
            BodyField::Fixed(count) => rest.get(*count..)?,
            BodyField::Text | BodyField::Numbers => counted(rest)?.1,
            BodyField::Texts => {
                let (mut texts, behind) = counted(rest)?;
                while !texts.is_empty() {
                    texts = counted(texts)?.1;
                }
                behind
            }
        };
    }
    Some(())
}

/// Parses a record.
///
/// # Errors
/// A description of what is wrong with the record.
pub(crate) fn parse_record(opcode: u8, body: &[u8]) -> Result<Record<'_>, String> {
    texts_fit(opcode, body).ok_or("string extends beyond its record")?;
    mcap::parse_record(opcode, body).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: the parser trusted the length of a name and allocated 1.9 GB for a metadata record of 8
    /// bytes.
    #[test]
    fn the_length_of_a_text_takes_no_memory_before_it_is_checked() {
        // The bytes before the first string of each record type, all zeros.
        let records = [
            (op::HEADER, 0),
            (op::SCHEMA, 2),
            (op::CHANNEL, 4),
            (op::CHUNK, 28),
            (op::CHUNK_INDEX, 44),
            (op::ATTACHMENT_INDEX, 40),
            (op::METADATA, 0),
            (op::METADATA_INDEX, 16),
        ];
        let refused = |opcode, body: &[u8]| parse_record(opcode, body).unwrap_err();
        for (opcode, before) in records {
            let body = [&vec![0; before][..], &0x7265_7474_u32.to_le_bytes(), &[0; 4]].concat();
            assert_eq!(refused(opcode, &body), "string extends beyond its record", "{opcode:#04x}");
        }
        // Inside a map: the map's length fits, a key's length does not.
        let long_key = [0_u32, 4, 0xffff_fff0].map(u32::to_le_bytes).concat();
        assert_eq!(refused(op::METADATA, &long_key), "string extends beyond its record");
    }

    #[test]
    fn records_that_are_right_are_parsed() {
        let text = |text: &str| [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat();
        let entries = [text("key"), text("value")].concat();
        let length = (entries.len() as u32).to_le_bytes();
        let map = [&length[..], &entries].concat();
        let metadata = [text("name"), map.clone()].concat();
        let Ok(Record::Metadata(found)) = parse_record(op::METADATA, &metadata) else { panic!("metadata") };
        assert_eq!((found.name.as_str(), found.metadata["key"].as_str()), ("name", "value"));
        let channel = [vec![1, 0, 2, 0], text("/topic"), text("cdr"), map].concat();
        assert!(matches!(parse_record(op::CHANNEL, &channel), Ok(Record::Channel(_))));
        let message = [0; 22];
        assert!(matches!(parse_record(op::MESSAGE, &message), Ok(Record::Message { .. })));
    }
}
