//! Macros that declare both a Rust item and an entry of the C header.

use std::ffi::c_char;

use ipc_types::messages::{
    Command, Event, Frame, Pose, Removed, RunControlReply, RunStatus, SensorReading, State, TipJacobian,
    Volume,
};

/// A type's spelling in C.
pub trait CType {
    /// C name; a pointer ends in `*`.
    const C: &'static str;
}

macro_rules! c_types {
    ($($rust:ty => $c:literal),* $(,)?) => {$(
        impl CType for $rust {
            const C: &'static str = $c;
        }
    )*};
}

c_types! {
    u32 => "uint32_t", i32 => "int32_t", u64 => "uint64_t", f64 => "double",
    *mut u64 => "uint64_t *",
    *const c_char => "const char *",
    *const u16 => "const uint16_t *", *const i16 => "const int16_t *", *const u32 => "const uint32_t *",
    *const State => "const trb_state *", *mut *const State => "const trb_state **",
    *mut *const SensorReading => "const trb_sensor_reading **",
    *mut *const TipJacobian => "const trb_tip_jacobian **",
    *mut *mut Command => "trb_command **",
    *const Pose => "const trb_pose *",
    *const Frame => "const trb_frame *", *const Volume => "const trb_volume *",
    *const Event => "const trb_event *", *const Removed => "const trb_removed *",
    *mut RunStatus => "trb_run_status *", *mut RunControlReply => "trb_run_control_reply *",
}

/// A function of the C ABI.
#[derive(Debug, Clone, Copy)]
pub struct Function {
    /// Name.
    pub name: &'static str,
    /// Documentation of the function.
    pub doc: &'static str,
    /// Arguments: name and C type.
    pub arguments: &'static [(&'static str, &'static str)],
    /// C return type.
    pub returns: &'static str,
}

/// A structure of the C ABI that is not a message.
#[derive(Debug, Clone, Copy)]
pub struct View {
    /// Name in C.
    pub name: &'static str,
    /// Documentation of the structure.
    pub doc: &'static str,
    /// Fields: name, C type, offset, documentation.
    pub fields: &'static [(&'static str, &'static str, usize, &'static str)],
    /// Size in bytes.
    pub size: usize,
}

/// Declares functions of the C ABI: the exported Rust functions, and [`Function`]s for the header.
macro_rules! functions {
    ($(
        $(#[doc = $doc:literal])*
        fn $name:ident($($argument:ident : $type:ty),* $(,)?) -> $returns:ty $body:block
    )*) => {
        $(
            $(#[doc = $doc])*
            ///
            /// # Safety
            /// Each pointer is null or points at what its C type says, for as long as the call lasts.
            #[unsafe(no_mangle)]
            pub unsafe extern "C" fn $name($($argument: $type),*) -> $returns $body
        )*

        /// Every function, in the order of the header.
        pub const FUNCTIONS: &[crate::ffi::Function] = &[$(
            crate::ffi::Function {
                name: stringify!($name),
                doc: concat!($($doc, "\n"),*),
                arguments: &[$((stringify!($argument), <$type as crate::ffi::CType>::C)),*],
                returns: <$returns as crate::ffi::CType>::C,
            },
        )*];
    };
}

/// Declares structures of the C ABI: the Rust structs, and [`View`]s for the header.
macro_rules! views {
    ($(
        $(#[doc = $doc:literal])*
        struct $name:ident = $c:literal {
            $( $(#[doc = $field_doc:literal])* $field:ident : $type:ty, )*
        }
    )*) => {
        $(
            $(#[doc = $doc])*
            #[repr(C)]
            #[derive(Debug, Clone, Copy)]
            pub struct $name {
                $( $(#[doc = $field_doc])* pub $field: $type, )*
            }
        )*

        /// All structures that are not messages, in header order.
        pub const VIEWS: &[crate::ffi::View] = &[$(
            crate::ffi::View {
                name: $c,
                doc: concat!($($doc, "\n"),*),
                fields: &[$((
                    stringify!($field),
                    <$type as crate::ffi::CType>::C,
                    core::mem::offset_of!($name, $field),
                    concat!($($field_doc, "\n"),*),
                )),*],
                size: core::mem::size_of::<$name>(),
            },
        )*];
    };
}
