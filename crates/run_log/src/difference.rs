//! Where two messages differ, field by field.

use messages::Tick;
use messages::layout::{Description, Element};

use crate::fields::{Scalar, element_size};
use crate::topics::Topic;

/// One scalar that differs.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldDifference {
    /// Path of the field, `t_world_link[7].position_m[2]`.
    pub path: String,
    /// Value in the first (recorded) message.
    pub recorded: Option<Scalar>,
    /// Value in the second (replayed) message.
    pub replayed: Option<Scalar>,
    /// Distance in units in the last place (ULP), for floats.
    pub ulps: Option<u64>,
}

impl std::fmt::Display for FieldDifference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let text = |value: &Option<Scalar>| value.map_or("nothing".to_string(), |value| value.to_string());
        write!(f, "{}: {} against {}", self.path, text(&self.recorded), text(&self.replayed))?;
        match self.ulps {
            Some(ulps) => write!(f, ", {ulps} ulp"),
            None => Ok(()),
        }
    }
}

/// The first tick at which two runs differ.
#[derive(Debug, Clone, PartialEq)]
pub struct Divergence {
    /// Topic of the message that differs.
    pub topic: Topic,
    /// `State.tick` of the tick.
    pub tick: Tick,
    /// Differing scalars in field order, the chained hash last; at most [`MAX_LISTED`].
    pub differences: Vec<FieldDifference>,
    /// Total number of differing scalars.
    pub total: usize,
}

/// Maximum number of differing scalars that are listed.
pub const MAX_LISTED: usize = 16;

impl std::fmt::Display for Divergence {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let saved = |difference: &FieldDifference| difference.path.starts_with("data[");
        if self.topic == Topic::Keyframe && self.differences.iter().all(saved) {
            // The bytes of a keyframe have no field names.
            let first = self.differences.first().map_or("", |difference| &difference.path);
            return write!(
                f,
                "first divergence: tick {}, {}: the keyframe differs in {} bytes, first at {first}. States \
                 are \
                 compared separately; a keyframe also contains what no state shows: the friction of tendons \
                 and contacts, the arm's trajectory, and the order in which a build stores them",
                self.tick, self.topic, self.total
            );
        }
        write!(f, "first divergence: tick {}, {}, {} values differ", self.tick, self.topic, self.total)?;
        self.differences.iter().try_for_each(|difference| write!(f, "\n  {difference}"))
    }
}

/// Compares two messages with the same description; returns `None` if all bytes agree.
pub fn compare(
    topic: Topic,
    tick: Tick,
    description: &'static Description,
    recorded: &[u8],
    replayed: &[u8],
) -> Option<Divergence> {
    if recorded == replayed {
        return None;
    }
    // Keep a few more than are listed, so that the chained hash can be moved to the end.
    let mut found = DifferenceList { most: MAX_LISTED + 2, ..DifferenceList::default() };
    found.message(description, "", recorded, replayed);
    if let Some(tail) = description.tail {
        let (a, b) = (recorded.get(description.size..), replayed.get(description.size..));
        let element = if tail.ros_type == "string" { "uint8" } else { tail.ros_type };
        found.elements(element, tail.name, tail.element_size, a.unwrap_or_default(), b.unwrap_or_default());
    }
    // Once two runs diverge, their chained hashes always differ. List the cause first.
    found.list.sort_by_key(|difference| difference.path.starts_with("hash["));
    found.list.truncate(MAX_LISTED);
    Some(Divergence { topic, tick, differences: found.list, total: found.total })
}

/// Compares two lists of voxel indices.
pub fn compare_removed(tick: Tick, recorded: &[u32], replayed: &[u32]) -> Option<Divergence> {
    if recorded == replayed {
        return None;
    }
    let bytes = |list: &[u32]| -> Vec<u8> { list.iter().flat_map(|index| index.to_le_bytes()).collect() };
    let mut found = DifferenceList { most: MAX_LISTED, ..DifferenceList::default() };
    if recorded.len() != replayed.len() {
        let length = |list: &[u32]| Some(Scalar::Unsigned(list.len() as u64));
        found.push("voxel_index_length".to_string(), length(recorded), length(replayed));
    }
    found.elements("uint32", "voxel_index", 4, &bytes(recorded), &bytes(replayed));
    found.list.truncate(MAX_LISTED);
    Some(Divergence { topic: Topic::Removed, tick, differences: found.list, total: found.total })
}

/// Returns all differing scalars, in field order, of two messages without tails and with the same
/// description.
pub fn all_differences(description: &'static Description, a: &[u8], b: &[u8]) -> Vec<FieldDifference> {
    let mut found = DifferenceList { most: usize::MAX, ..DifferenceList::default() };
    found.message(description, "", a, b);
    found.list
}

#[derive(Default)]
struct DifferenceList {
    list: Vec<FieldDifference>,
    /// Maximum number to keep.
    most: usize,
    total: usize,
}

impl DifferenceList {
    fn push(&mut self, path: String, recorded: Option<Scalar>, replayed: Option<Scalar>) {
        self.total += 1;
        if self.list.len() < self.most {
            let ulps = recorded.zip(replayed).and_then(|(a, b)| a.ulp_distance(&b));
            self.list.push(FieldDifference { path, recorded, replayed, ulps });
        }
    }

    fn message(&mut self, description: &'static Description, prefix: &str, a: &[u8], b: &[u8]) {
        for field in description.fields {
            let range = field.offset..field.offset + field.size;
            let (a, b) = (a.get(range.clone()).unwrap_or_default(), b.get(range).unwrap_or_default());
            if a == b {
                continue;
            }
            let path = format!("{prefix}{}", field.name);
            match (field.element, field.array_length) {
                (Element::Scalar(ros), None) => self.push(path, Scalar::read(ros, a), Scalar::read(ros, b)),
                (Element::Scalar(ros), Some(_)) => self.elements(ros, &path, element_size(field), a, b),
                (Element::Message(nested), None) => self.message(nested, &format!("{path}."), a, b),
                (Element::Message(nested), Some(length)) => {
                    let size = element_size(field);
                    for i in 0..length {
                        let part = |bytes: &[u8]| bytes.get(i * size..(i + 1) * size).map(<[u8]>::to_vec);
                        let (a, b) = (part(a).unwrap_or_default(), part(b).unwrap_or_default());
                        if a != b {
                            self.message(nested, &format!("{path}[{i}]."), &a, &b);
                        }
                    }
                }
            }
        }
    }

    fn elements(&mut self, ros: &str, path: &str, size: usize, a: &[u8], b: &[u8]) {
        let size = size.max(1);
        for i in 0..a.len().max(b.len()).div_ceil(size) {
            let part =
                |bytes: &[u8]| bytes.get(i * size..(i + 1) * size).and_then(|part| Scalar::read(ros, part));
            let (a, b) = (part(a), part(b));
            if a.map(|value| value.bits()) != b.map(|value| value.bits()) {
                self.push(format!("{path}[{i}]"), a, b);
            }
        }
    }
}
