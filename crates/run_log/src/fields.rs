//! Reads fields from a message's bytes, using its generated description.

use foreign_text::nearest_name;
use messages::layout::{Description, Element, Field};

/// One scalar of a message.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Scalar {
    /// `uint8` to `uint64`.
    Unsigned(u64),
    /// `int8` to `int64`.
    Signed(i64),
    /// `float32`.
    Float32(f32),
    /// `float64`.
    Float64(f64),
}

impl Scalar {
    /// The nearest `f64`, for plots.
    pub fn nearest_f64(self) -> f64 {
        match self {
            Scalar::Unsigned(value) => value as f64,
            Scalar::Signed(value) => value as f64,
            Scalar::Float32(value) => f64::from(value),
            Scalar::Float64(value) => value,
        }
    }

    /// Reads a little-endian scalar of a ROS type. Returns `None` if the type is not a scalar or there are
    /// too few bytes.
    pub fn read(ros_type: &str, bytes: &[u8]) -> Option<Scalar> {
        let word = |n: usize| -> Option<u64> {
            let mut buffer = [0u8; 8];
            buffer.get_mut(..n)?.copy_from_slice(bytes.get(..n)?);
            Some(u64::from_le_bytes(buffer))
        };
        Some(match ros_type {
            "uint8" | "bool" => Scalar::Unsigned(word(1)?),
            "uint16" => Scalar::Unsigned(word(2)?),
            "uint32" => Scalar::Unsigned(word(4)?),
            "uint64" => Scalar::Unsigned(word(8)?),
            "int8" => Scalar::Signed(i64::from(word(1)? as u8 as i8)),
            "int16" => Scalar::Signed(i64::from(word(2)? as u16 as i16)),
            "int32" => Scalar::Signed(i64::from(word(4)? as u32 as i32)),
            "int64" => Scalar::Signed(word(8)? as i64),
            "float32" => Scalar::Float32(f32::from_bits(word(4)? as u32)),
            "float64" => Scalar::Float64(f64::from_bits(word(8)?)),
            _ => return None,
        })
    }

    /// The raw bits as stored in the message.
    pub fn bits(&self) -> u64 {
        match *self {
            Scalar::Unsigned(value) => value,
            Scalar::Signed(value) => value as u64,
            Scalar::Float32(value) => u64::from(value.to_bits()),
            Scalar::Float64(value) => value.to_bits(),
        }
    }

    /// Returns the number of representable values between two floats of one type; `None` for integers, NaN
    /// and mixed types. `-0.0` and `0.0` are 1 apart because their bits differ.
    pub fn ulp_distance(&self, other: &Scalar) -> Option<u64> {
        match (*self, *other) {
            (Scalar::Float64(a), Scalar::Float64(b)) if !a.is_nan() && !b.is_nan() => Some(
                u64::try_from(ordered(a.to_bits(), 64).abs_diff(ordered(b.to_bits(), 64)))
                    .unwrap_or(u64::MAX),
            ),
            (Scalar::Float32(a), Scalar::Float32(b)) if !a.is_nan() && !b.is_nan() => {
                let (a, b) = (u64::from(a.to_bits()), u64::from(b.to_bits()));
                u64::try_from(ordered(a, 32).abs_diff(ordered(b, 32))).ok()
            }
            _ => None,
        }
    }
}

/// Maps float bits to integers that sort like the floats, so that neighbouring floats are 1 apart.
fn ordered(bits: u64, width: u32) -> i128 {
    let sign = 1u64 << (width - 1);
    let magnitude = i128::from(bits & !(sign | if width == 32 { !0u64 << 32 } else { 0 }));
    if bits & sign == 0 { magnitude } else { -1 - magnitude }
}

impl std::fmt::Display for Scalar {
    /// Floats are printed with just enough digits to round-trip.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Scalar::Unsigned(value) => write!(f, "{value}"),
            Scalar::Signed(value) => write!(f, "{value}"),
            Scalar::Float32(value) => write!(f, "{value:e} (0x{:08x})", value.to_bits()),
            Scalar::Float64(value) => write!(f, "{value:e} (0x{:016x})", value.to_bits()),
        }
    }
}

/// Returns the number of tail elements according to the message's count field; `None` without a tail or with
/// too few bytes.
pub fn tail_count(description: &Description, message: &[u8]) -> Option<usize> {
    description.tail?;
    let count = description.fields.last()?;
    let bytes = message.get(count.offset..count.offset + 4)?;
    Some(u32::from_le_bytes(bytes.try_into().ok()?) as usize)
}

/// Returns the expected size of a message: its struct plus the tail announced by its count field.
pub fn message_size(description: &Description, message: &[u8]) -> Option<usize> {
    match description.tail {
        None => Some(description.size),
        Some(tail) => {
            let bytes = tail_count(description, message)?.checked_mul(tail.element_size)?;
            description.size.checked_add(bytes)
        }
    }
}

/// Size of one element in bytes.
pub fn element_size(field: &Field) -> usize {
    field.size / field.array_length.unwrap_or(1).max(1)
}

/// Where a field path such as `t_world_link[7].position_m[2]` points.
#[derive(Debug, Clone)]
pub struct FieldLocation {
    /// The path as given.
    pub path: String,
    /// Type of one element.
    pub element: Element,
    /// Number of elements if the path names a whole array.
    pub array_length: Option<usize>,
    /// Offset in the message in bytes.
    pub offset: usize,
    /// Size in bytes.
    pub size: usize,
}

/// Describes an unknown field name: the closest valid name, and all valid names.
fn no_field(description: &Description, name: &str) -> String {
    let nearest = nearest_name(name, description.fields.iter().map(|field| field.name));
    let meant = nearest.map_or(String::new(), |near| format!(" (did you mean '{near}'?)"));
    let names: Vec<&str> = description.fields.iter().map(|field| field.name).collect();
    format!("{} has no field '{name}'{meant}; available: {}", description.short_name(), names.join(", "))
}

/// Finds a field by its path. The error says where the path stops matching.
pub fn find(description: &'static Description, path: &str) -> Result<FieldLocation, String> {
    let mut current = description;
    let mut offset = 0;
    let mut segments = path.split('.').peekable();
    while let Some(segment) = segments.next() {
        let (name, index) = split_index(segment)?;
        let field = current.fields.iter().find(|field| field.name == name);
        let field = field.ok_or_else(|| no_field(current, name))?;
        let mut place = FieldLocation {
            path: path.to_string(),
            element: field.element,
            array_length: field.array_length,
            offset: offset + field.offset,
            size: field.size,
        };
        if let Some(index) = index {
            let length = field.array_length.ok_or_else(|| format!("'{name}' is not an array"))?;
            if index >= length {
                return Err(format!("'{name}' has {length} elements, index {index} is out of range"));
            }
            place.offset += index * element_size(field);
            place.array_length = None;
            place.size = element_size(field);
        }
        if segments.peek().is_none() {
            return Ok(place);
        }
        match (place.element, place.array_length) {
            (Element::Message(nested), None) => (current, offset) = (nested, place.offset),
            (Element::Message(_), Some(_)) => return Err(format!("'{name}' is an array: give an index")),
            (Element::Scalar(_), _) => return Err(format!("'{name}' has no fields")),
        }
    }
    Err("the path is empty".to_string())
}

fn split_index(segment: &str) -> Result<(&str, Option<usize>), String> {
    match segment.split_once('[') {
        None => Ok((segment, None)),
        Some((name, rest)) => {
            let index = rest.strip_suffix(']').and_then(|digits| digits.parse().ok());
            index
                .map(|index| (name, Some(index)))
                .ok_or_else(|| format!("'{segment}' is malformed; expected name[index]"))
        }
    }
}
