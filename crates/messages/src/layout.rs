//! The single source for a message's layout: the Rust type, its `ros2msg` schema, its field table and its
//! layout hash.
//!
//! Each message is declared once, with [`message!`](crate::message). The bytes of such a struct, after the
//! four bytes of [`CDR_LITTLE_ENDIAN`], are a valid CDR (XCDR1, little-endian) message of the generated
//! schema, because no field is padded: `zerocopy::IntoBytes` proves that at compile time.

use sha2::{Digest, Sha256};

/// CDR encapsulation header that turns a message's bytes into a `cdr` message of its `ros2msg` schema (OMG
/// DDS-XTypes 1.3, 7.6.2.1.2: `CDR_LE`). Common readers refuse `00 07` (XCDR2).
pub const CDR_LITTLE_ENDIAN: [u8; 4] = [0, 1, 0, 0];

const _: () = assert!(
    cfg!(target_endian = "little"),
    "messages are little-endian: big-endian targets are not supported"
);

/// The type of a field's elements: a scalar of the ROS interface language, or another message.
#[derive(Debug, Clone, Copy)]
pub enum Element {
    /// A scalar, by its ROS name (`float64`, `uint32`, …).
    Scalar(&'static str),
    /// A nested message.
    Message(&'static Description),
}

impl Element {
    /// Returns the element's name in a `ros2msg` schema.
    pub fn ros_name(&self) -> &'static str {
        match self {
            Element::Scalar(name) => name,
            Element::Message(description) => description.name,
        }
    }
}

/// One field of a message: its position and meaning.
#[derive(Debug, Clone, Copy)]
pub struct Field {
    /// Name, ROS-legal, with its unit at the end.
    pub name: &'static str,
    /// Type of one element.
    pub element: Element,
    /// Number of elements if the field is a fixed array.
    pub array_length: Option<usize>,
    /// Offset in bytes from the message's start, the same in C and in CDR.
    pub offset: usize,
    /// Size in bytes.
    pub size: usize,
    /// Its documentation.
    pub doc: &'static str,
}

/// The tail of a variable-length message: the last field of the struct is its element count.
#[derive(Debug, Clone, Copy)]
pub struct Tail {
    /// Name of the sequence in the schema.
    pub name: &'static str,
    /// ROS element type; `string` for UTF-8 text with a final NUL, which the count includes.
    pub ros_type: &'static str,
    /// Size of one element in bytes.
    pub element_size: usize,
}

/// A message's layout, generated from its declaration.
#[derive(Debug, Clone, Copy)]
pub struct Description {
    /// Schema name, `trabecula_msgs/msg/<Type>`.
    pub name: &'static str,
    /// The message's documentation.
    pub doc: &'static str,
    /// Fields in order. With a tail, the last one is its element count.
    pub fields: &'static [Field],
    /// Size in bytes, without the tail.
    pub size: usize,
    /// Elements that follow the struct.
    pub tail: Option<Tail>,
}

/// A type that can be a field of a message.
pub trait WireType {
    /// Type of one element.
    const ELEMENT: Element;
    /// Number of elements if this is a fixed array.
    const ARRAY_LENGTH: Option<usize> = None;
}

/// A message: a fixed layout with a generated schema.
pub trait Message:
    Copy + zerocopy::FromBytes + zerocopy::IntoBytes + zerocopy::Immutable + zerocopy::KnownLayout
{
    /// The generated layout.
    const DESCRIPTION: &'static Description;
}

macro_rules! scalars {
    ($($rust:ty => $ros:literal),* $(,)?) => {$(
        impl WireType for $rust {
            const ELEMENT: Element = Element::Scalar($ros);
        }
    )*};
}
scalars! {
    u8 => "uint8", u16 => "uint16", u32 => "uint32", u64 => "uint64",
    i8 => "int8", i16 => "int16", i32 => "int32", i64 => "int64", f32 => "float32", f64 => "float64",
}

impl<T: WireType, const N: usize> WireType for [T; N] {
    const ELEMENT: Element = {
        assert!(T::ARRAY_LENGTH.is_none(), "an array of arrays has no ROS type: flatten it");
        T::ELEMENT
    };
    const ARRAY_LENGTH: Option<usize> = Some(N);
}

/// Declares a message: a `#[repr(C)]` struct of plain scalars, arrays and other messages, together with its
/// schema.
///
/// A hole between fields, a pointer or a type without a ROS name does not compile. A variable-length message
/// ends in `tail name: [element] = "ros type"`; the struct then ends in a `u32` element count named
/// `<name>_length`.
#[macro_export]
macro_rules! message {
    (
        $(#[doc = $doc:literal])*
        pub struct $name:ident = $ros:literal {
            $( $(#[doc = $field_doc:literal])* $field:ident : $type:ty, )*
        }
        $( tail $tail:ident : [$tail_type:ty] = $tail_ros:literal )?
    ) => {
        $(#[doc = $doc])*
        #[repr(C)]
        #[derive(
            Debug, Clone, Copy, PartialEq,
            zerocopy::FromBytes, zerocopy::IntoBytes, zerocopy::Immutable, zerocopy::KnownLayout,
        )]
        pub struct $name {
            $( $(#[doc = $field_doc])* pub $field: $type, )*
        }

        impl $name {
            /// Creates a message of zeros.
            pub fn zeroed() -> Self {
                zerocopy::FromZeros::new_zeroed()
            }
        }

        impl $crate::layout::WireType for $name {
            const ELEMENT: $crate::layout::Element =
                $crate::layout::Element::Message(<$name as $crate::layout::Message>::DESCRIPTION);
        }

        impl $crate::layout::Message for $name {
            const DESCRIPTION: &'static $crate::layout::Description = &$crate::layout::Description {
                name: $ros,
                doc: concat!($($doc, "\n"),*),
                fields: &[$(
                    $crate::layout::Field {
                        name: stringify!($field),
                        element: <$type as $crate::layout::WireType>::ELEMENT,
                        array_length: <$type as $crate::layout::WireType>::ARRAY_LENGTH,
                        offset: core::mem::offset_of!($name, $field),
                        size: core::mem::size_of::<$type>(),
                        doc: concat!($($field_doc, "\n"),*),
                    },
                )*],
                size: core::mem::size_of::<$name>(),
                tail: $crate::message!(@tail $( $tail $tail_type, $tail_ros )?),
            };
        }

        const _: () = assert!(core::mem::align_of::<$name>() <= 8, "CDR aligns to 8 bytes at most");
    };
    (@tail) => { None };
    (@tail $tail:ident $tail_type:ty, $tail_ros:literal) => {
        Some($crate::layout::Tail {
            name: stringify!($tail),
            ros_type: $tail_ros,
            element_size: core::mem::size_of::<$tail_type>(),
        })
    };
}

impl Description {
    /// Returns the type's name without its package: `State`.
    pub fn short_name(&self) -> &'static str {
        self.name.rsplit('/').next().unwrap_or(self.name)
    }

    /// Checks that a message's length matches its type and its own count. A `Frame` is followed by an image,
    /// whose prefix gives its lengths.
    ///
    /// # Errors
    /// The expected length, as text.
    pub fn check_length(&self, bytes: &[u8]) -> Result<(), String> {
        let Some((message, rest)) = bytes.split_at_checked(self.size) else {
            return Err(format!("at least {} ({})", self.size, self.name));
        };
        match (self.tail, message.last_chunk()) {
            (Some(tail), Some(count)) => {
                let count = u32::from_le_bytes(*count);
                let expected = count as usize * tail.element_size;
                if rest.len() == expected {
                    return Ok(());
                }
                Err(format!("{} for {count} elements of `{}`", self.size + expected, tail.name))
            }
            _ if rest.is_empty() || self.short_name() == "Frame" => Ok(()),
            _ => Err(format!("{} ({})", self.size, self.name)),
        }
    }

    /// Returns the fields listed in the schema: all except the tail's count.
    pub fn schema_fields(&self) -> &'static [Field] {
        let count = self.fields.len() - usize::from(self.tail.is_some());
        &self.fields[..count]
    }

    /// Returns the `ros2msg` schema text, followed by the definition of each nested message.
    pub fn schema(&self) -> String {
        let mut text = self.definition();
        let mut seen = vec![self.name];
        let mut queue = self.nested();
        while let Some(nested) = queue.pop() {
            if seen.contains(&nested.name) {
                continue;
            }
            seen.push(nested.name);
            text.push_str(&"=".repeat(80));
            text.push_str(&format!("\nMSG: {}\n", nested.name.replace("/msg/", "/")));
            text.push_str(&nested.definition());
            queue.extend(nested.nested());
        }
        text
    }

    fn nested(&self) -> Vec<&'static Description> {
        let message = |field: &Field| match field.element {
            Element::Message(description) => Some(description),
            Element::Scalar(_) => None,
        };
        self.fields.iter().filter_map(message).collect()
    }

    fn definition(&self) -> String {
        let mut text = String::new();
        for field in self.schema_fields() {
            let array = field.array_length.map_or(String::new(), |n| format!("[{n}]"));
            let element = field.element.ros_name().replace("/msg/", "/");
            text.push_str(&format!("{element}{array} {}\n", field.name));
        }
        if let Some(tail) = self.tail {
            let array = if tail.ros_type == "string" { "" } else { "[]" };
            text.push_str(&format!("{}{array} {}\n", tail.ros_type, tail.name));
        }
        text
    }

    /// Returns the hash of the layout: the first 16 hexadecimal digits of the SHA-256 of schema and offsets.
    pub fn layout_hash(&self) -> String {
        let mut text = format!("{}{}", self.name, self.schema());
        for field in self.fields {
            text.push_str(&format!("{}@{}+{}\n", field.name, field.offset, field.size));
        }
        fingerprint(&text)
    }
}

/// Returns the first 16 hexadecimal digits of a text's SHA-256.
pub fn fingerprint(text: &str) -> String {
    hex(&Sha256::digest(text)[..8])
}

/// Formats bytes as lower-case hexadecimal digits.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
