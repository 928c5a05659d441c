//! Message definitions of ROS 2 as text (`ros2msg`), and fields of messages that they describe.
//!
//! The text is that of `.msg` files with nested definitions after lines of `=` (mcap.dev/spec/registry);
//! messages are CDR (OMG DDS-XTypes 1.3, 7.4.1: XCDR1), in either byte order.

use std::collections::BTreeMap;
use std::fmt;

/// Deepest nesting of messages; ROS's own have at most six.
const MAX_DEPTH: usize = 32;

/// Types of one element.
#[derive(Debug, Clone)]
enum Element {
    /// Size in bytes, and how to read it.
    Scalar(usize, fn(&[u8]) -> f64),
    Text,
    Message(String),
}

/// Number of elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Count {
    One,
    Fixed(usize),
    Sequence,
}

#[derive(Debug, Clone)]
struct Field {
    name: String,
    element: Element,
    count: Count,
}

/// A parsed definition.
#[derive(Debug, Clone)]
pub struct Definition {
    root: String,
    messages: BTreeMap<String, Vec<Field>>,
}

/// Place of a number in a message: `pose.position.x`, `effort[0]`, or a time such as `header.stamp`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FieldPath(Vec<(String, Option<usize>)>);

/// Why a definition or message cannot be read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DefinitionError {
    /// A line of the definition that is not a field.
    Line(String),
    /// A type that is not defined.
    NoType(String),
    /// Messages nested too deeply, or in themselves.
    Depth,
    /// The message is shorter than its definition.
    Short,
    /// Not CDR in a known encoding.
    Encoding,
}

impl fmt::Display for DefinitionError {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            DefinitionError::Line(line) => write!(out, "malformed line: {}", line.escape_debug()),
            DefinitionError::NoType(name) => write!(out, "undefined type: {}", name.escape_debug()),
            DefinitionError::Depth => write!(out, "messages nested more than {MAX_DEPTH} deep"),
            DefinitionError::Short => write!(out, "truncated message"),
            DefinitionError::Encoding => write!(out, "unsupported encoding, expected plain CDR"),
        }
    }
}

impl std::error::Error for DefinitionError {}

macro_rules! reader {
    ($type:ty) => {
        |bytes: &[u8]| {
            let mut buffer = [0; size_of::<$type>()];
            buffer.copy_from_slice(&bytes[..size_of::<$type>()]);
            <$type>::from_le_bytes(buffer) as f64
        }
    };
}

/// Returns the type of a scalar by its ROS name.
fn scalar(name: &str) -> Option<Element> {
    Some(match name {
        "bool" | "byte" | "char" | "uint8" => Element::Scalar(1, |bytes| f64::from(bytes[0])),
        "int8" => Element::Scalar(1, reader!(i8)),
        "uint16" => Element::Scalar(2, reader!(u16)),
        "int16" => Element::Scalar(2, reader!(i16)),
        "uint32" => Element::Scalar(4, reader!(u32)),
        "int32" => Element::Scalar(4, reader!(i32)),
        "uint64" => Element::Scalar(8, reader!(u64)),
        "int64" => Element::Scalar(8, reader!(i64)),
        "float32" => Element::Scalar(4, reader!(f32)),
        "float64" => Element::Scalar(8, reader!(f64)),
        _ => return None,
    })
}

/// Returns a type's full name, `package/Type`.
fn full_name(name: &str, package: &str) -> String {
    match name {
        "Header" => "std_msgs/Header".to_owned(),
        _ if name.contains('/') => name.replacen("/msg/", "/", 1),
        _ => format!("{package}/{name}"),
    }
}

/// Parses a line of a definition; `None` for constants, comments and empty lines.
fn field(line: &str, package: &str) -> Result<Option<Field>, DefinitionError> {
    let line = line.split('#').next().unwrap_or_default().trim();
    let malformed = || DefinitionError::Line(line.to_owned());
    let Some((kind, rest)) = line.split_once(char::is_whitespace) else {
        return if line.is_empty() { Ok(None) } else { Err(malformed()) };
    };
    let rest = rest.trim_start();
    let name: String = rest.chars().take_while(|c| c.is_ascii_alphanumeric() || *c == '_').collect();
    if rest[name.len()..].trim_start().starts_with('=') {
        return Ok(None);
    }
    if name.is_empty() {
        return Err(malformed());
    }
    let (base, count) = match kind.split_once('[') {
        None => (kind, Count::One),
        Some((base, count)) => {
            let count = count.strip_suffix(']').ok_or_else(malformed)?;
            match count.is_empty() || count.starts_with("<=") {
                true => (base, Count::Sequence),
                false => (base, Count::Fixed(count.parse().map_err(|_| malformed())?)),
            }
        }
    };
    let base = base.split("<=").next().unwrap_or(base);
    let element = match base {
        "string" => Element::Text,
        "wstring" => return Err(malformed()),
        _ => scalar(base).unwrap_or_else(|| Element::Message(full_name(base, package))),
    };
    Ok(Some(Field { name, element, count }))
}

impl Definition {
    /// Parses the definition of a message type, followed by those of the types that it uses.
    ///
    /// # Errors
    /// A malformed line, an undefined type, or types nested too deeply.
    pub fn parse(name: &str, text: &str) -> Result<Definition, DefinitionError> {
        let root = full_name(name, "");
        let mut messages = BTreeMap::new();
        let mut current = root.clone();
        let mut fields = Vec::new();
        let mut is_boundary = false;
        for line in text.lines() {
            if line.len() > 10 && line.chars().all(|c| c == '=') {
                is_boundary = true;
            } else if let Some(next) = line.strip_prefix("MSG:").filter(|_| is_boundary) {
                messages.insert(std::mem::replace(&mut current, full_name(next.trim(), "")), fields);
                fields = Vec::new();
                is_boundary = false;
            } else {
                let package = current.split('/').next().unwrap_or_default().to_owned();
                fields.extend(field(line, &package)?);
            }
        }
        messages.insert(current, fields);
        // ROS tools leave out the definitions of these two.
        for name in ["builtin_interfaces/Time", "builtin_interfaces/Duration"] {
            let second = if name.ends_with("Time") { "uint32" } else { "int32" };
            messages.entry(name.to_owned()).or_insert_with(|| {
                let part = |kind: &str, name: &str| {
                    scalar(kind).map(|element| Field { name: name.to_owned(), element, count: Count::One })
                };
                [part("int32", "sec"), part(second, "nanosec")].into_iter().flatten().collect()
            });
        }
        let definition = Definition { root, messages };
        definition.check(&definition.root, 0)?;
        Ok(definition)
    }

    fn check(&self, name: &str, depth: usize) -> Result<(), DefinitionError> {
        if depth > MAX_DEPTH {
            return Err(DefinitionError::Depth);
        }
        let fields = self.messages.get(name).ok_or_else(|| DefinitionError::NoType(name.to_owned()))?;
        let nested = fields.iter().filter_map(|field| match &field.element {
            Element::Message(name) => Some(name),
            _ => None,
        });
        // A type that uses another in several fields is checked once.
        nested
            .collect::<std::collections::BTreeSet<_>>()
            .into_iter()
            .try_for_each(|it| self.check(it, depth + 1))
    }

    /// Finds a number by its path.
    ///
    /// # Errors
    /// The names at the place where the path ends to match.
    pub fn path(&self, text: &str) -> Result<FieldPath, Vec<String>> {
        let mut path = Vec::new();
        let mut at = self.root.clone();
        let mut segments = text.split('.').peekable();
        while let Some(segment) = segments.next() {
            let fields = self.messages.get(&at).map(Vec::as_slice).unwrap_or_default();
            let names = || {
                let name = |field: &Field| match field.count {
                    Count::One => field.name.clone(),
                    Count::Fixed(_) | Count::Sequence => format!("{}[0]", field.name),
                };
                let before = text.rsplit_once(segment).map_or("", |(before, _)| before);
                fields.iter().map(|field| format!("{before}{}", name(field))).collect::<Vec<_>>()
            };
            let (name, index) = match segment.split_once('[') {
                None => (segment, None),
                Some((name, index)) => {
                    let index = index.strip_suffix(']').and_then(|index| index.parse::<usize>().ok());
                    (name, Some(index.ok_or_else(names)?))
                }
            };
            let field = fields.iter().find(|field| field.name == name).ok_or_else(names)?;
            let is_indexed = match field.count {
                Count::One => index.is_none(),
                Count::Fixed(count) => index.is_some_and(|index| index < count),
                Count::Sequence => index.is_some(),
            };
            if !is_indexed {
                return Err(names());
            }
            path.push((name.to_owned(), index));
            match (&field.element, segments.peek()) {
                (Element::Message(next), Some(_)) => at.clone_from(next),
                (Element::Message(next), None) if is_time(next) => {}
                (Element::Scalar(..), None) => {}
                _ => return Err(names()),
            }
        }
        Ok(FieldPath(path))
    }

    /// Returns the number at a path of a message, with its encapsulation header; a time in seconds.
    /// `None` if a sequence is too short.
    ///
    /// # Errors
    /// The message is truncated, or not plain CDR.
    pub fn value(&self, path: &FieldPath, message: &[u8]) -> Result<Option<f64>, DefinitionError> {
        let (header, body) = message.split_at_checked(4).ok_or(DefinitionError::Short)?;
        let is_big = match header {
            [0, 0, ..] => true,
            [0, 1, ..] => false,
            _ => return Err(DefinitionError::Encoding),
        };
        let mut reader = Reader { body, at: 0, is_big };
        self.walk(&self.root, &mut reader, Some(&path.0))
    }

    /// Reads a message, up to the path's number if there is one.
    fn walk(
        &self,
        name: &str,
        reader: &mut Reader<'_>,
        path: Option<&[(String, Option<usize>)]>,
    ) -> Result<Option<f64>, DefinitionError> {
        let fields = self.messages.get(name).ok_or(DefinitionError::Short)?;
        if fields.is_empty() {
            // CDR has no empty structure: ROS puts a byte there.
            reader.take(1, 1)?;
        }
        if path.is_some_and(<[_]>::is_empty) {
            let [sec, nanosec] = [reader.word()?, reader.word()?];
            return Ok(Some(f64::from(sec as i32) + f64::from(nanosec) * 1e-9));
        }
        for field in fields {
            let wanted = path.and_then(<[_]>::split_first).filter(|((name, _), _)| *name == field.name);
            let count = match field.count {
                Count::One => 1,
                Count::Fixed(count) => count,
                Count::Sequence => reader.word()? as usize,
            };
            let index = wanted.map(|((_, index), _)| index.unwrap_or(0));
            if index.is_some_and(|index| index >= count) {
                return Ok(None);
            }
            for element in 0..count {
                let rest = wanted.filter(|_| index == Some(element)).map(|(_, rest)| rest);
                match &field.element {
                    Element::Scalar(size, read) => {
                        let bytes = reader.take(*size, *size)?;
                        if rest.is_some() {
                            let mut little = [0; 8];
                            little[..*size].copy_from_slice(bytes);
                            if reader.is_big {
                                little[..*size].reverse();
                            }
                            return Ok(Some(read(&little)));
                        }
                    }
                    Element::Text => {
                        let length = reader.word()? as usize;
                        reader.take(length, 1)?;
                    }
                    Element::Message(next) => {
                        let found = self.walk(next, reader, rest)?;
                        if rest.is_some() {
                            return Ok(found);
                        }
                    }
                }
            }
        }
        Ok(None)
    }
}

fn is_time(name: &str) -> bool {
    matches!(name, "builtin_interfaces/Time" | "builtin_interfaces/Duration")
}

/// The body of a message.
struct Reader<'a> {
    body: &'a [u8],
    at: usize,
    is_big: bool,
}

impl<'a> Reader<'a> {
    /// Takes bytes after alignment.
    fn take(&mut self, size: usize, alignment: usize) -> Result<&'a [u8], DefinitionError> {
        let start = self.at.next_multiple_of(alignment);
        let end = start.checked_add(size).ok_or(DefinitionError::Short)?;
        let bytes = self.body.get(start..end).ok_or(DefinitionError::Short)?;
        self.at = end;
        Ok(bytes)
    }

    fn word(&mut self) -> Result<u32, DefinitionError> {
        let bytes = self.take(4, 4)?;
        let mut word = [0; 4];
        word.copy_from_slice(bytes);
        Ok(if self.is_big { u32::from_be_bytes(word) } else { u32::from_le_bytes(word) })
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by it")]
mod tests {
    use super::*;
    use crate::cdr;
    use crate::msg::JointState;

    /// `sensor_msgs/JointState` as recorders store it (comments shortened).
    const JOINT_STATE: &str = "\
# The state of joints.
std_msgs/Header header

string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";

    /// The bytes are those of the bridge's own encoder, which other programs read.
    #[test]
    fn fields_of_a_joint_state_are_found_behind_texts_and_sequences() {
        let definition = Definition::parse("sensor_msgs/msg/JointState", JOINT_STATE).unwrap();
        let mut state = JointState {
            name: vec!["tendon_0".to_owned(), "b".to_owned()],
            position: vec![0.25, -1.5],
            effort: vec![5.0],
            ..JointState::default()
        };
        state.header.stamp.sec = 12;
        state.header.stamp.nanosec = 500_000_000;
        state.header.frame_id = "world".to_owned();
        // Recorders store the encapsulation header too.
        let bytes = [vec![0, 1, 0, 0], cdr::encode(&state).unwrap()].concat();
        let value = |path: &str| definition.value(&definition.path(path).unwrap(), &bytes).unwrap();
        assert_eq!(value("position[1]"), Some(-1.5));
        assert_eq!(value("effort[0]"), Some(5.0));
        assert_eq!(value("velocity[0]"), None);
        assert_eq!(value("header.stamp"), Some(12.5));
        let path = definition.path("effort[0]").unwrap();
        for cut in 0..bytes.len() {
            assert!(definition.value(&path, &bytes[..cut]).is_err(), "{cut}");
        }
    }

    #[test]
    fn wrong_paths_are_answered_with_the_names_that_fit() {
        let definition = Definition::parse("sensor_msgs/msg/JointState", JOINT_STATE).unwrap();
        for path in ["efort[0]", "effort", "name[0]", "header", "effort[x]", "effort[0].x", ""] {
            let names = definition.path(path).unwrap_err();
            assert!(!names.is_empty() || path.contains(".x"), "{path}: {names:?}");
        }
        let names = definition.path("header.stmp").unwrap_err();
        assert_eq!(names, ["header.stamp", "header.frame_id"]);
    }

    #[test]
    fn malformed_definitions_are_refused() {
        let nested = "a/A x\n================\nMSG: a/A\na/A x\n";
        for (text, expected) in [
            ("float64", DefinitionError::Line("float64".to_owned())),
            ("float64[x] a", DefinitionError::Line("float64[x] a".to_owned())),
            ("other/Type a", DefinitionError::NoType("other/Type".to_owned())),
            (nested, DefinitionError::Depth),
        ] {
            assert_eq!(Definition::parse("a/msg/B", text).unwrap_err(), expected, "{text}");
        }
    }

    /// Constants, defaults, bounds and comments of rosidl's grammar; big-endian scalars of each size.
    #[test]
    fn constants_defaults_and_bounds_are_skipped_and_byte_orders_are_kept_apart() {
        let text = "int32 LIMIT=5\nuint8 a 7\nstring<=5 text \"x\"\nfloat32[<=3] some # three\nint16[2] pair\nint64 z\n";
        let definition = Definition::parse("a/msg/B", text).unwrap();
        let mut bytes = vec![0, 0, 0, 0, 9, 0, 0, 0];
        bytes.extend([0, 0, 0, 2, b'x', 0, 0, 0]);
        bytes.extend([0, 0, 0, 1]);
        bytes.extend(1.5_f32.to_be_bytes());
        bytes.extend([0xff, 0xfe, 0, 3]);
        bytes.extend((-4_i64).to_be_bytes());
        let value = |path: &str| definition.value(&definition.path(path).unwrap(), &bytes).unwrap();
        let found = ["a", "some[0]", "some[1]", "pair[0]", "pair[1]", "z"].map(value);
        assert_eq!(found, [Some(9.0), Some(1.5), None, Some(-2.0), Some(3.0), Some(-4.0)]);
    }
}
