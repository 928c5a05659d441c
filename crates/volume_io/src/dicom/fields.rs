//! Elements of a DICOM data set as text and numbers.

use super::elements::{self, Elements, Tag, Value};
use crate::error::{Field, VolumeError};
use std::path::Path;

/// Longest value that is read, bytes: a position in digits takes a hundredth of it.
const MAX_VALUE_BYTES: usize = 1 << 14;

/// The elements of a data set, or of an item in a sequence.
#[derive(Clone, Copy)]
pub(super) struct Fields<'a> {
    pub path: &'a Path,
    /// The bytes in which the elements are.
    pub bytes: &'a [u8],
    pub elements: &'a Elements,
}

impl<'a> Fields<'a> {
    pub fn wrong(&self, tag: Tag, name: &str, given: String, expected: &str) -> VolumeError {
        let name = format!("{tag} {name}");
        VolumeError::header(self.path, name.trim_end(), given, expected)
    }

    /// The value as text; `None` if the element is absent or empty.
    pub fn text(&self, tag: Tag) -> Result<Option<String>, VolumeError> {
        let Some(Value::Bytes { vr, big_endian, range }) = self.elements.get(tag) else { return Ok(None) };
        if range.len() > MAX_VALUE_BYTES {
            let expected = format!("at most {MAX_VALUE_BYTES} bytes");
            return Err(self.wrong(tag, "", format!("{} bytes", range.len()), &expected));
        }
        let bytes = self.bytes.get(range.clone()).unwrap_or_default();
        let text = elements::text(*vr, *big_endian, bytes).map_err(|unit| {
            let expected = format!("a multiple of {unit} bytes");
            self.wrong(tag, "", format!("{} bytes", bytes.len()), &expected)
        })?;
        let text = text.trim_end_matches(['\0', ' ']).trim();
        Ok((!text.is_empty()).then(|| text.to_string()))
    }

    pub fn numbers<const N: usize>(&self, tag: Tag, name: &str) -> Result<[f64; N], VolumeError> {
        let expected = format!("{N} finite numbers");
        let Some(text) = self.text(tag)? else {
            return Err(self.wrong(tag, name, "no value".into(), &expected));
        };
        let parsed: Option<Vec<f64>> =
            text.split('\\').map(|word| word.trim().parse().ok().filter(|n: &f64| n.is_finite())).collect();
        let array = parsed.and_then(|values| <[f64; N]>::try_from(values).ok());
        array.ok_or_else(|| self.wrong(tag, name, format!("`{text}`"), &expected))
    }

    pub fn number(&self, tag: Tag, name: &str) -> Result<f64, VolumeError> {
        self.numbers::<1>(tag, name).map(|[value]| value)
    }

    pub fn optional(&self, tag: Tag, name: &str) -> Result<Option<f64>, VolumeError> {
        if self.text(tag)?.is_none() { Ok(None) } else { self.number(tag, name).map(Some) }
    }

    /// Refuses colour images and look-up tables before any pixel is read.
    pub fn refuse_other_layouts(&self) -> Result<(), VolumeError> {
        let samples = self.optional(Tag(0x0028, 0x0002), "SamplesPerPixel")?.unwrap_or(1.0);
        let photometric = self.text(Tag(0x0028, 0x0004))?.unwrap_or_else(|| "MONOCHROME2".into());
        if samples != 1.0 || !photometric.starts_with("MONOCHROME") {
            return Err(VolumeError::NotScalar(Field::new(
                self.path,
                "(0028,0002) SamplesPerPixel, (0028,0004) PhotometricInterpretation",
                format!("{samples}, {photometric}"),
            )));
        }
        if self.elements.get(Tag(0x0028, 0x3000)).is_some() {
            return Err(VolumeError::unsupported(
                self.path,
                "(0028,3000) ModalityLUTSequence",
                "a lookup table",
                "RescaleSlope and RescaleIntercept",
            ));
        }
        Ok(())
    }

    /// The items of a sequence; empty if it is absent.
    pub fn items(self, tag: Tag) -> impl ExactSizeIterator<Item = Fields<'a>> {
        let items = match self.elements.get(tag) {
            Some(Value::Items(items)) => items.as_slice(),
            _ => &[],
        };
        items.iter().map(move |elements| Fields { elements, ..self })
    }

    /// The single item of a sequence; `None` if it is absent or empty.
    pub fn item(&self, tag: Tag) -> Option<Fields<'a>> {
        self.items(tag).next()
    }
}
