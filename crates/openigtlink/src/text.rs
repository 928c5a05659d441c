//! STRING and STATUS.

use crate::Error;
use crate::bytes::{FieldWriter, Fields, check_text, u16_of};

pub(crate) const STRING: &str = "STRING";
pub(crate) const STATUS: &str = "STATUS";

/// US-ASCII and UTF-8 in IANA's registry of character sets (MIBenum).
const ASCII: u16 = 3;
const UTF8: u16 = 106;
const ERROR_NAME_BYTES: usize = 20;

pub(crate) fn write_string(text: &str, body: &mut Vec<u8>) -> Result<(), Error> {
    body.put_u16(if text.is_ascii() { ASCII } else { UTF8 });
    body.put_u16(u16_of(STRING, "length", text.len())?);
    body.put(text.as_bytes());
    Ok(())
}

pub(crate) fn read_string(body: &[u8]) -> Result<String, Error> {
    let mut fields = Fields::new(STRING, body);
    let encoding = fields.u16()?;
    if encoding != ASCII && encoding != UTF8 {
        let expected = "3 (ASCII) or 106 (UTF-8)";
        return Err(Error::Field { kind: STRING, field: "encoding", given: encoding.to_string(), expected });
    }
    let length = usize::from(fields.u16()?);
    let text = String::from_utf8_lossy(fields.take(length)?).into_owned();
    fields.end()?;
    Ok(text)
}

/// The result of a request. Codes that this crate's users do not need keep their number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StatusCode {
    /// 1: success.
    Ok,
    /// 5: the sender lacks permission.
    AccessDenied,
    /// 9: no such thing.
    NotFound,
    /// 13: the device is not ready for it.
    NotReady,
    /// 14: in manual mode; commands are ignored.
    ManualMode,
    /// 15: disabled.
    Disabled,
    /// 18: the device's own error.
    HardwareOrSoftware,
    /// 19: unknown message.
    Unknown,
    /// Any other.
    Other(u16),
}

/// Numbers of the codes, from the protocol's STATUS page.
const CODES: [(StatusCode, u16); 8] = [
    (StatusCode::Ok, 1),
    (StatusCode::AccessDenied, 5),
    (StatusCode::NotFound, 9),
    (StatusCode::NotReady, 13),
    (StatusCode::ManualMode, 14),
    (StatusCode::Disabled, 15),
    (StatusCode::HardwareOrSoftware, 18),
    (StatusCode::Unknown, 19),
];

impl StatusCode {
    fn number(self) -> u16 {
        match self {
            StatusCode::Other(number) => number,
            code => CODES.iter().find(|(of, _)| *of == code).map_or(0, |(_, number)| *number),
        }
    }

    fn of(number: u16) -> StatusCode {
        CODES.iter().find(|(_, of)| *of == number).map_or(StatusCode::Other(number), |(code, _)| *code)
    }
}

/// A device's answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Status {
    /// Result of the request.
    pub code: StatusCode,
    /// Device-specific number.
    pub subcode: u64,
    /// Name of the error, at most 19 bytes; empty if there is none.
    pub error: String,
    /// A sentence in ASCII.
    pub message: String,
}

pub(crate) fn write_status(status: &Status, body: &mut Vec<u8>) -> Result<(), Error> {
    body.put_u16(status.code.number());
    body.put_u64(status.subcode);
    body.put_padded("an error's name", &status.error, ERROR_NAME_BYTES)?;
    check_text("a status message", &status.message, usize::from(u16::MAX))?;
    body.put(status.message.as_bytes());
    body.put_u8(0);
    Ok(())
}

pub(crate) fn read_status(body: &[u8]) -> Result<Status, Error> {
    let mut fields = Fields::new(STATUS, body);
    let code = StatusCode::of(fields.u16()?);
    let subcode = fields.u64()?;
    let error = fields.padded(ERROR_NAME_BYTES)?;
    let left = fields.left();
    Ok(Status { code, subcode, error, message: fields.padded(left)? })
}
