//! Reads and writes big-endian fields.

use crate::Error;

/// Reads fields from the front of a body.
pub(crate) struct Fields<'a> {
    kind: &'static str,
    whole: usize,
    rest: &'a [u8],
}

impl<'a> Fields<'a> {
    pub(crate) fn new(kind: &'static str, body: &'a [u8]) -> Fields<'a> {
        Fields { kind, whole: body.len(), rest: body }
    }

    pub(crate) fn take(&mut self, bytes: usize) -> Result<&'a [u8], Error> {
        let Some((taken, rest)) = self.rest.split_at_checked(bytes) else {
            let read = self.whole - self.rest.len();
            return Err(self.length(format!("at least {}", read.saturating_add(bytes))));
        };
        self.rest = rest;
        Ok(taken)
    }

    pub(crate) fn array<const N: usize>(&mut self) -> Result<[u8; N], Error> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    pub(crate) fn u8(&mut self) -> Result<u8, Error> {
        self.array::<1>().map(|[byte]| byte)
    }

    pub(crate) fn u16(&mut self) -> Result<u16, Error> {
        self.array().map(u16::from_be_bytes)
    }

    pub(crate) fn u32(&mut self) -> Result<u32, Error> {
        self.array().map(u32::from_be_bytes)
    }

    pub(crate) fn u64(&mut self) -> Result<u64, Error> {
        self.array().map(u64::from_be_bytes)
    }

    /// Reads a finite number.
    pub(crate) fn f32(&mut self, field: &'static str) -> Result<f32, Error> {
        let value = self.array().map(f32::from_be_bytes)?;
        if value.is_finite() {
            return Ok(value);
        }
        Err(Error::Field { kind: self.kind, field, given: value.to_string(), expected: "a finite number" })
    }

    pub(crate) fn vector(&mut self, field: &'static str) -> Result<[f32; 3], Error> {
        Ok([self.f32(field)?, self.f32(field)?, self.f32(field)?])
    }

    /// Reads a text in a field of fixed length, terminated by NUL or by the field's end.
    pub(crate) fn padded(&mut self, bytes: usize) -> Result<String, Error> {
        let field = self.take(bytes)?;
        let end = field.iter().position(|byte| *byte == 0).unwrap_or(bytes);
        Ok(String::from_utf8_lossy(&field[..end]).into_owned())
    }

    pub(crate) fn rest(&mut self) -> &'a [u8] {
        std::mem::take(&mut self.rest)
    }

    pub(crate) fn left(&self) -> usize {
        self.rest.len()
    }

    /// Fails if bytes are left over.
    pub(crate) fn end(&self) -> Result<(), Error> {
        if self.rest.is_empty() {
            return Ok(());
        }
        Err(self.length((self.whole - self.rest.len()).to_string()))
    }

    pub(crate) fn length(&self, expected: String) -> Error {
        Error::Length { kind: self.kind, bytes: self.whole, expected }
    }
}

/// Writes fields to the end of a body.
pub(crate) trait FieldWriter {
    fn put(&mut self, bytes: &[u8]);

    fn put_u8(&mut self, value: u8) {
        self.put(&[value]);
    }

    fn put_u16(&mut self, value: u16) {
        self.put(&value.to_be_bytes());
    }

    fn put_u32(&mut self, value: u32) {
        self.put(&value.to_be_bytes());
    }

    fn put_u64(&mut self, value: u64) {
        self.put(&value.to_be_bytes());
    }

    fn put_f32s(&mut self, values: &[f32]) {
        for value in values {
            self.put(&value.to_be_bytes());
        }
    }

    /// Writes a text, padded with NUL. One byte always stays NUL, because receivers written in C treat the
    /// field as a string.
    fn put_padded(&mut self, field: &'static str, text: &str, bytes: usize) -> Result<(), Error> {
        check_text(field, text, bytes - 1)?;
        self.put(text.as_bytes());
        for _ in text.len()..bytes {
            self.put_u8(0);
        }
        Ok(())
    }
}

impl FieldWriter for Vec<u8> {
    fn put(&mut self, bytes: &[u8]) {
        self.extend_from_slice(bytes);
    }
}

pub(crate) fn check_text(field: &'static str, text: &str, most: usize) -> Result<(), Error> {
    if text.len() <= most && text.is_ascii() && !text.contains('\0') {
        return Ok(());
    }
    Err(Error::Text { field, text: text.chars().take(80).collect(), bytes: text.len(), most })
}

/// Converts a length to a 16-bit field.
pub(crate) fn u16_of(kind: &'static str, field: &'static str, value: usize) -> Result<u16, Error> {
    u16::try_from(value).map_err(|_| Error::Field {
        kind,
        field,
        given: value.to_string(),
        expected: "0 to 65535",
    })
}

/// Converts a length to a 32-bit field.
pub(crate) fn u32_of(kind: &'static str, field: &'static str, value: usize) -> Result<u32, Error> {
    u32::try_from(value).map_err(|_| Error::Field {
        kind,
        field,
        given: value.to_string(),
        expected: "0 to 4294967295",
    })
}
