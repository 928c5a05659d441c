//! Elements of a DICOM data set as text and numbers.

use crate::error::{Field, VolumeError};
use dicom_object::{InMemDicomObject, Tag};
use std::path::Path;

/// An error and its causes on one line.
pub(super) fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(inner) = cause {
        text.push_str(": ");
        text.push_str(&inner.to_string());
        cause = inner.source();
    }
    text
}

/// The elements of a data set, or of an item in a sequence.
#[derive(Clone, Copy)]
pub(super) struct Fields<'a> {
    pub path: &'a Path,
    pub object: &'a InMemDicomObject,
}

impl<'a> Fields<'a> {
    pub fn wrong(&self, tag: Tag, name: &str, given: String, expected: &str) -> VolumeError {
        VolumeError::header(
            self.path,
            format!("({:04x},{:04x}) {name}", tag.group(), tag.element()),
            given,
            expected,
        )
    }

    /// The value as text; `None` if the element is absent or empty.
    pub fn text(&self, tag: Tag) -> Result<Option<String>, VolumeError> {
        let Ok(element) = self.object.element(tag) else { return Ok(None) };
        match element.to_str() {
            Ok(text) => {
                let text = text.trim_end_matches('\0').trim();
                Ok((!text.is_empty()).then(|| text.to_string()))
            }
            Err(error) => Err(self.wrong(tag, "", chain(&error), "a value")),
        }
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
        if self.object.element(Tag(0x0028, 0x3000)).is_ok() {
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
    pub fn items(&self, tag: Tag) -> Vec<Fields<'a>> {
        let items = self.object.element(tag).ok().and_then(|element| element.items()).unwrap_or_default();
        items.iter().map(|object| Fields { path: self.path, object }).collect()
    }

    /// The single item of a sequence; `None` if it is absent or empty.
    pub fn item(&self, tag: Tag) -> Option<Fields<'a>> {
        self.items(tag).into_iter().next()
    }
}
