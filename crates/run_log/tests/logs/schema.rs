//! Parses the schemas' text with an independent parser, lays them out by the rules of CDR, and compares the
//! offsets with those of the structs.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::collections::BTreeMap;

use messages::layout::{Description, Element, Message};
use messages::{ALL, ImagePrefix, SENSOR_MSGS_IMAGE_SCHEMA};

#[derive(Debug, Clone, Copy, PartialEq)]
enum Length {
    One,
    Fixed(usize),
    Sequence,
}

type Fields = Vec<(String, Length, String)>;

/// Definitions by type name; the root's name is empty.
fn parse(text: &str) -> BTreeMap<String, Fields> {
    let (mut types, mut name) = (BTreeMap::new(), String::new());
    types.insert(String::new(), Fields::new());
    for line in text.lines() {
        if line.starts_with("====") {
            assert_eq!(line.len(), 80);
        } else if let Some(next) = line.strip_prefix("MSG: ") {
            name = next.to_string();
            types.insert(name.clone(), Fields::new());
        } else {
            let (kind, field) = line.split_once(' ').unwrap();
            let (kind, length) = match kind.split_once('[') {
                None => (kind, Length::One),
                Some((kind, "]")) => (kind, Length::Sequence),
                Some((kind, n)) => (kind, Length::Fixed(n.strip_suffix(']').unwrap().parse().unwrap())),
            };
            types.get_mut(&name).unwrap().push((kind.to_string(), length, field.to_string()));
        }
    }
    types
}

fn scalar_size(kind: &str) -> Option<usize> {
    Some(match kind {
        "bool" | "byte" | "char" | "int8" | "uint8" => 1,
        "int16" | "uint16" => 2,
        "int32" | "uint32" | "float32" => 4,
        "int64" | "uint64" | "float64" => 8,
        _ => return None,
    })
}

/// Walks a message as an XCDR1 stream (DDS-XTypes 1.3, 7.4.1): a scalar is aligned to its size, counted from
/// the start of the body; a structure has no alignment of its own; a string or a sequence is its length as
/// uint32, then its content. Records the offset of each scalar as `path@offset`; `lengths` gives the lengths
/// of strings and sequences in order.
struct Walk<'a> {
    types: &'a BTreeMap<String, Fields>,
    at: usize,
    found: Vec<String>,
    lengths: Vec<usize>,
}

impl Walk<'_> {
    fn message(&mut self, kind: &str, prefix: &str) {
        for (kind, length, field) in self.types[kind].clone() {
            let path = format!("{prefix}{field}");
            match length {
                Length::One => self.one(&kind, &path),
                Length::Fixed(n) => (0..n).for_each(|i| self.one(&kind, &format!("{path}[{i}]"))),
                Length::Sequence => {
                    self.one("uint32", &format!("{path}_length"));
                    let n = self.lengths.remove(0);
                    (0..n).for_each(|i| self.one(&kind, &format!("{path}[{i}]")));
                }
            }
        }
    }

    fn one(&mut self, kind: &str, path: &str) {
        if kind == "string" {
            self.one("uint32", &format!("{path}_length"));
            let n = self.lengths.remove(0);
            self.found.push(format!("{path}@{}", self.at));
            self.at += n;
        } else if let Some(size) = scalar_size(kind) {
            self.at = self.at.next_multiple_of(size);
            self.found.push(format!("{path}@{}", self.at));
            self.at += size;
        } else {
            self.message(kind, &format!("{path}."));
        }
    }
}

fn described(description: &'static Description, base: usize, prefix: &str, out: &mut Vec<String>) {
    for field in description.fields {
        let size = field.size / field.array_length.unwrap_or(1);
        for i in 0..field.array_length.unwrap_or(1) {
            let index = field.array_length.map_or(String::new(), |_| format!("[{i}]"));
            let path = format!("{prefix}{}{index}", field.name);
            let offset = base + field.offset + i * size;
            match field.element {
                Element::Scalar(name) => {
                    assert_eq!(scalar_size(name), Some(size));
                    out.push(format!("{path}@{offset}"));
                }
                Element::Message(nested) => described(nested, offset, &format!("{path}."), out),
            }
        }
    }
}

#[test]
fn every_message_is_a_cdr_message_of_its_schema() {
    let mut scalars = 0;
    for description in ALL {
        let types = parse(&description.schema());
        let mut walk = Walk { types: &types, at: 0, found: Vec::new(), lengths: vec![3] };
        walk.message("", "");
        let mut expected = Vec::new();
        described(description, 0, "", &mut expected);
        if let Some(tail) = description.tail {
            // Three elements directly after the struct; a string is one scalar here.
            let count = if tail.ros_type == "string" { 1 } else { 3 };
            for i in 0..count {
                let index = if tail.ros_type == "string" { String::new() } else { format!("[{i}]") };
                expected.push(format!("{}{index}@{}", tail.name, description.size + i * tail.element_size));
            }
            assert_eq!(walk.at, description.size + 3 * tail.element_size, "{}", description.name);
        } else {
            assert_eq!(walk.at, description.size, "{}", description.name);
        }
        assert_eq!(walk.found, expected, "{}", description.name);
        scalars += expected.len();
    }
    println!("{} messages, {scalars} scalars at their CDR offsets", ALL.len());
}

#[test]
fn the_image_prefix_is_a_sensor_msgs_image() {
    let types = parse(SENSOR_MSGS_IMAGE_SCHEMA);
    let mut walk = Walk { types: &types, at: 0, found: Vec::new(), lengths: vec![8, 7, 4] };
    walk.message("", "");
    let expected = [
        "header.stamp.sec@0",
        "header.stamp.nanosec@4",
        "header.frame_id_length@8",
        "header.frame_id@12",
        "height@20",
        "width@24",
        "encoding_length@28",
        "encoding@32",
        "is_bigendian@39",
        "step@40",
        "data_length@44",
        "data[0]@48",
        "data[1]@49",
        "data[2]@50",
        "data[3]@51",
    ];
    assert_eq!(walk.found, expected);
    let offsets: Vec<usize> = ImagePrefix::DESCRIPTION.fields.iter().map(|field| field.offset).collect();
    assert_eq!(offsets, [0, 4, 8, 12, 20, 24, 28, 32, 39, 40, 44]);
    assert_eq!(ImagePrefix::DESCRIPTION.size, 48);
}
