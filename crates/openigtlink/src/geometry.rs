//! TRANSFORM: a pose.

use crate::Error;
use crate::bytes::{FieldWriter, Fields};

pub(crate) const TRANSFORM: &str = "TRANSFORM";

/// A pose: the axes and origin of a frame in its parent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Transform {
    /// Rotation matrix, `rotation[row][column]`; column j is the child's axis j in the parent.
    pub rotation: [[f32; 3]; 3],
    /// The child's origin in the parent.
    pub translation_mm: [f32; 3],
}

/// Writes the columns first, then the translation: R11 R21 R31 R12 … R33 TX TY TZ.
pub(crate) fn write(transform: &Transform, body: &mut Vec<u8>) {
    put_columns(&transform.rotation, body);
    body.put_f32s(&transform.translation_mm);
}

pub(crate) fn read(body: &[u8]) -> Result<Transform, Error> {
    let mut fields = Fields::new(TRANSFORM, body);
    let transform = Transform {
        rotation: columns(&mut fields, "rotation")?,
        translation_mm: fields.vector("translation")?,
    };
    fields.end()?;
    Ok(transform)
}

pub(crate) fn put_columns(matrix: &[[f32; 3]; 3], body: &mut Vec<u8>) {
    for column in 0..3 {
        body.put_f32s(&matrix.map(|row| row[column]));
    }
}

pub(crate) fn columns(fields: &mut Fields<'_>, field: &'static str) -> Result<[[f32; 3]; 3], Error> {
    let axes = [fields.vector(field)?, fields.vector(field)?, fields.vector(field)?];
    Ok([0, 1, 2].map(|row| axes.map(|axis| axis[row])))
}
