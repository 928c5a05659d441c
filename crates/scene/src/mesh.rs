//! Triangles of the mesh files with which an arm is drawn: STL, binary or as text, and OBJ.
//!
//! The files are as foreign as any: a count is believed only if the file is as long as it says, and no
//! coordinate may be infinite or NaN.

use std::io::Cursor;
use std::path::Path;

use foreign_text::foreign;
use thiserror::Error;

/// Triangles of an arm, at most: some ten times those of a whole arm's published meshes.
pub const MOST_TRIANGLES: usize = 500_000;
/// Bytes of a mesh file, at most: a binary STL of [`MOST_TRIANGLES`] has 25 MB.
pub const MAX_MESH_BYTES: u64 = 32 << 20;
/// Farthest that a mesh may reach from the frame of its link, m.
pub const FARTHEST_M: f64 = 10.0;

/// Bytes of a binary STL before its triangles: 80 of any text, then how many there are.
const STL_HEAD_BYTES: usize = 84;
/// Bytes of a triangle there: normal and corners as 12 float32, and 2 bytes that mean nothing.
const STL_TRIANGLE_BYTES: usize = 50;

/// Three corners, counterclockwise seen from outside, in the file's unit.
pub type Triangle = [[f32; 3]; 3];

/// Kind of a mesh file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeshFormat {
    /// STL, binary or as text.
    Stl,
    /// Wavefront OBJ; only its corners and faces count.
    Obj,
}

impl MeshFormat {
    /// By the end of the file's name; `None` for a kind that is not read, such as COLLADA (`.dae`).
    pub fn of(path: &Path) -> Option<MeshFormat> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "stl" => Some(MeshFormat::Stl),
            "obj" => Some(MeshFormat::Obj),
            _ => None,
        }
    }
}

/// Why a mesh file is refused.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum MeshError {
    /// Neither form of STL.
    #[error("is no STL: its {bytes} bytes neither begin with `solid` nor are a count's 84 and 50 a triangle{}", told(*.count))]
    NotStl {
        /// Length of the file.
        bytes: usize,
        /// Triangles that a binary file of these bytes would announce.
        count: Option<u32>,
    },
    /// The reader's reason.
    #[error("is damaged: {}", foreign(.cause))]
    Damaged {
        /// What it met.
        cause: String,
    },
    /// A face that is none.
    #[error("has a face of {corners} corners in line {line}, expected 3 or more; the file may be cut")]
    ShortFace {
        /// Line, from 1.
        line: usize,
        /// Corners that it names.
        corners: usize,
    },
    /// A corner without a place.
    #[error("has a corner of triangle {triangle} that is infinite or no number; expected finite coordinates")]
    NotFinite {
        /// Triangle, from 1.
        triangle: usize,
    },
    /// Nothing to draw.
    #[error("holds no triangle with an area; expected 1 or more")]
    Empty,
    /// More than an arm may have.
    #[error(
        "has more than {most} triangles, with those of the arm's other meshes {MOST_TRIANGLES} at most; expected a coarser mesh"
    )]
    TooMany {
        /// Room that the other meshes left.
        most: usize,
    },
}

fn told(count: Option<u32>) -> String {
    count.map_or(String::new(), |count| format!(", and it announces {count}"))
}

/// The triangles of a file's content, `most` of them at most.
///
/// Formats: Marshall Burns, "Automated Fabrication" (1993), section 6.5 (STL); Wavefront's "Object Files",
/// appendix B1 (OBJ).
///
/// # Errors
/// [`MeshError`]: the content is none of its kind, holds no triangle or too many, or a corner that is nowhere.
pub fn triangles(content: &[u8], format: MeshFormat, most: usize) -> Result<Vec<Triangle>, MeshError> {
    let triangles = match format {
        MeshFormat::Stl => stl(content, most)?,
        MeshFormat::Obj => obj(content, most)?,
    };
    let is_nowhere = |triangle: &Triangle| triangle.iter().flatten().any(|x| !x.is_finite());
    if let Some(index) = triangles.iter().position(is_nowhere) {
        return Err(MeshError::NotFinite { triangle: index + 1 });
    }
    match triangles.iter().any(has_area) {
        true => Ok(triangles),
        false => Err(MeshError::Empty),
    }
}

fn has_area([a, b, c]: &Triangle) -> bool {
    let side = |corner: &[f32; 3]| [0, 1, 2].map(|axis| f64::from(corner[axis]) - f64::from(a[axis]));
    let ([x, y, z], [u, v, w]) = (side(b), side(c));
    [y * w - z * v, z * u - x * w, x * v - y * u].iter().any(|part| *part != 0.0)
}

fn damaged(cause: &impl ToString) -> MeshError {
    MeshError::Damaged { cause: cause.to_string() }
}

/// The count decides what is binary: the text of a binary file may begin with `solid`, too.
fn stl(content: &[u8], most: usize) -> Result<Vec<Triangle>, MeshError> {
    let count =
        content.get(80..STL_HEAD_BYTES).and_then(|bytes| bytes.try_into().ok()).map(u32::from_le_bytes);
    let length_of = |count: u32| STL_HEAD_BYTES as u64 + STL_TRIANGLE_BYTES as u64 * u64::from(count);
    let readable = if let Some(count) = count.filter(|count| length_of(*count) == content.len() as u64) {
        if count as usize > most {
            return Err(MeshError::TooMany { most });
        }
        [&[0; 80], &content[80..]].concat()
    } else if content.starts_with(b"solid") {
        // The reader wants a name in the first line, which not every program writes.
        let rest = content.iter().position(|byte| *byte == b'\n').map_or(&[][..], |end| &content[end..]);
        [b"solid mesh", rest].concat()
    } else {
        return Err(MeshError::NotStl { bytes: content.len(), count });
    };
    let mut readable = Cursor::new(readable);
    let mut triangles = Vec::new();
    for triangle in stl_io::create_stl_reader(&mut readable).map_err(|cause| damaged(&cause))? {
        if triangles.len() == most {
            return Err(MeshError::TooMany { most });
        }
        triangles.push(triangle.map_err(|cause| damaged(&cause))?.vertices.map(|corner| corner.0));
    }
    Ok(triangles)
}

/// A face of an OBJ with fewer than three corners, which its reader would take for a line or a point.
fn short_face(content: &[u8]) -> Option<MeshError> {
    (1..).zip(content.split(|byte| *byte == b'\n')).find_map(|(line, text)| {
        let mut words = text.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let is_face = words.next() == Some(b"f");
        let corners = words.take_while(|word| !word.starts_with(b"#")).count();
        (is_face && corners < 3).then_some(MeshError::ShortFace { line, corners })
    })
}

fn obj(content: &[u8], most: usize) -> Result<Vec<Triangle>, MeshError> {
    if let Some(error) = short_face(content) {
        return Err(error);
    }
    let options = tobj::LoadOptions {
        triangulate: true,
        ignore_points: true,
        ignore_lines: true,
        ..tobj::LoadOptions::default()
    };
    // Colours are in files of their own, which nobody asks for.
    let without_materials = |_: &Path| Err(tobj::LoadError::OpenFileFailed);
    let mut content = content;
    let (models, _) =
        tobj::load_obj_buf(&mut content, &options, without_materials).map_err(|cause| damaged(&cause))?;
    let mut triangles = Vec::new();
    for mesh in models.iter().map(|model| &model.mesh) {
        if triangles.len() + mesh.indices.len() / 3 > most {
            return Err(MeshError::TooMany { most });
        }
        let corner = |index: u32| {
            let at = index as usize * 3;
            mesh.positions.get(at..at + 3).and_then(|place| place.try_into().ok())
        };
        for face in mesh.indices.chunks_exact(3) {
            let [Some(a), Some(b), Some(c)] = [face[0], face[1], face[2]].map(corner) else {
                return Err(damaged(&"a face names a corner that is not there"));
            };
            triangles.push([a, b, c]);
        }
    }
    Ok(triangles)
}
