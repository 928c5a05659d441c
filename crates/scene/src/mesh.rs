//! Triangles of the mesh files that an arm is drawn with: STL (binary or ASCII) and OBJ.
//!
//! The files are untrusted: a count is believed only if it matches the file's length, and no coordinate may
//! be infinite or NaN.

use std::path::Path;

use foreign_text::foreign;
use thiserror::Error;

/// Largest number of triangles of an arm: some ten times those of a whole arm's published meshes.
pub const MOST_TRIANGLES: usize = 500_000;
/// Largest mesh file: a binary STL of [`MOST_TRIANGLES`] has 25 MB.
pub const MAX_MESH_BYTES: u64 = 32 << 20;
/// Largest distance of a mesh from its link's frame, m.
pub const FARTHEST_M: f64 = 10.0;

/// Bytes of a binary STL before its triangles: 80 of free text, then the triangle count.
const STL_HEAD_BYTES: usize = 84;
/// Bytes per triangle: normal and corners as 12 float32, and 2 unused bytes.
const STL_TRIANGLE_BYTES: usize = 50;

/// Three corners, counterclockwise seen from outside, in the file's unit.
pub type Triangle = [[f32; 3]; 3];

/// Kind of a mesh file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeshFormat {
    /// STL, binary or ASCII.
    Stl,
    /// Wavefront OBJ; only vertices and faces are read.
    Obj,
}

impl MeshFormat {
    /// The format by file extension; `None` for an unsupported one, such as COLLADA (`.dae`).
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
    /// Neither binary nor ASCII STL.
    #[error("is not an STL file: its {bytes} bytes neither begin with `solid` nor fit a binary STL (84 bytes \
             plus 50 per triangle){}", told(*.count))]
    NotStl {
        /// Length of the file.
        bytes: usize,
        /// Triangle count in the header, if read as a binary file.
        count: Option<u32>,
    },
    /// The reader failed.
    #[error("is malformed: {}", foreign(.cause))]
    Damaged {
        /// The reader's message.
        cause: String,
    },
    /// A face with too few corners.
    #[error(
        "has a face with {corners} corners in line {line}, expected 3 or more; the file may be truncated"
    )]
    ShortFace {
        /// Line, from 1.
        line: usize,
        /// Number of corners.
        corners: usize,
    },
    /// A coordinate is infinite or NaN.
    #[error("has an infinite or NaN coordinate in triangle {triangle}; expected finite coordinates")]
    NotFinite {
        /// Triangle, from 1.
        triangle: usize,
    },
    /// Nothing to draw.
    #[error("has no triangle with an area; expected 1 or more")]
    Empty,
    /// More triangles than an arm may have.
    #[error(
        "has more than {most} triangles; all meshes of the arm together may have {MOST_TRIANGLES}, so use a \
         coarser mesh"
    )]
    TooMany {
        /// Triangles left by the other meshes.
        most: usize,
    },
}

fn told(count: Option<u32>) -> String {
    count.map_or(String::new(), |count| format!("; its header declares {count} triangles"))
}

/// Reads at most `most` triangles from a file's content.
///
/// Formats: Marshall Burns, "Automated Fabrication" (1993), section 6.5 (STL); Wavefront's "Object Files",
/// appendix B1 (OBJ).
///
/// # Errors
/// [`MeshError`]: the content is malformed, has no or too many triangles, or a coordinate that is not finite.
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

/// Blanks and zeros, which programs write around the content.
fn is_padding(byte: u8) -> bool {
    byte == 0 || byte.is_ascii_whitespace()
}

/// The count decides whether the file is binary: a binary file's header can begin with `solid`, too.
fn stl(content: &[u8], most: usize) -> Result<Vec<Triangle>, MeshError> {
    let count =
        content.get(80..STL_HEAD_BYTES).and_then(|bytes| bytes.try_into().ok()).map(u32::from_le_bytes);
    let length_of = |count: u32| STL_HEAD_BYTES as u64 + STL_TRIANGLE_BYTES as u64 * u64::from(count);
    let declared = count.filter(|count| length_of(*count) <= content.len() as u64);
    if let Some(count) = declared {
        let (binary, rest) = content.split_at(length_of(count) as usize);
        // A file of zeros is no STL.
        if rest.is_empty() || (count > 0 && rest.iter().all(|byte| is_padding(*byte))) {
            return match count as usize > most {
                true => Err(MeshError::TooMany { most }),
                false => Ok(binary_triangles(&binary[STL_HEAD_BYTES..])),
            };
        }
    }
    let begin = content.iter().position(|byte| !is_padding(*byte)).unwrap_or(content.len());
    match content.get(begin..begin + 5) {
        Some(word) if word.eq_ignore_ascii_case(b"solid") => {
            AsciiStl { content, rest: content }.triangles(most)
        }
        _ => Err(MeshError::NotStl { bytes: content.len(), count }),
    }
}

/// The corners in the 50 bytes of each triangle, after its normal.
fn binary_triangles(bytes: &[u8]) -> Vec<Triangle> {
    let float = |four: &[u8; 4]| f32::from_le_bytes(*four);
    let each = bytes.as_chunks::<STL_TRIANGLE_BYTES>().0.iter();
    each.map(|triangle| {
        let (numbers, _) = triangle[12..48].as_chunks::<4>();
        [0, 1, 2].map(|corner| [0, 1, 2].map(|axis| float(&numbers[3 * corner + axis])))
    })
    .collect()
}

/// Reads ASCII STL: `solid` blocks, any number of them, in upper or lower case.
struct AsciiStl<'a> {
    content: &'a [u8],
    /// What is not read yet: the end of `content`.
    rest: &'a [u8],
}

impl<'a> AsciiStl<'a> {
    /// The next word; `None` at the end.
    fn next(&mut self) -> Option<&'a [u8]> {
        let begin = self.rest.iter().position(|byte| !is_padding(*byte)).unwrap_or(self.rest.len());
        self.rest = &self.rest[begin..];
        let end = self.rest.iter().position(|byte| is_padding(*byte)).unwrap_or(self.rest.len());
        let word;
        (word, self.rest) = self.rest.split_at(end);
        Some(word).filter(|word| !word.is_empty())
    }

    fn skip_line(&mut self) {
        let end = self.rest.iter().position(|byte| matches!(byte, b'\n' | b'\r'));
        self.rest = &self.rest[end.unwrap_or(self.rest.len())..];
    }

    fn wrong(&self, found: Option<&[u8]>, expected: &str) -> MeshError {
        let found = found.map_or("the end".into(), |word| format!("`{}`", String::from_utf8_lossy(word)));
        let read = &self.content[..self.content.len() - self.rest.len()];
        let count = |end: u8| read.iter().filter(|byte| **byte == end).count();
        let line = 1 + count(b'\n').max(count(b'\r'));
        damaged(&format!("found {found} in line {line}, expected {expected}"))
    }

    /// Takes these words.
    fn expect(&mut self, words: &[&str]) -> Result<(), MeshError> {
        words.iter().try_for_each(|expected| {
            let found = self.next();
            let is_it = found.is_some_and(|word| word.eq_ignore_ascii_case(expected.as_bytes()));
            if is_it { Ok(()) } else { Err(self.wrong(found, &format!("`{expected}`"))) }
        })
    }

    fn coordinate(&mut self) -> Result<f32, MeshError> {
        let word = self.next();
        let number = word.and_then(|word| core::str::from_utf8(word).ok()?.parse::<f32>().ok());
        number.filter(|x| x.is_finite()).ok_or_else(|| self.wrong(word, "a finite coordinate"))
    }

    fn triangles(mut self, most: usize) -> Result<Vec<Triangle>, MeshError> {
        let mut triangles = Vec::new();
        while let Some(word) = self.next() {
            if !word.eq_ignore_ascii_case(b"solid") {
                return Err(self.wrong(Some(word), "`solid`"));
            }
            // The rest of the line is a name.
            self.skip_line();
            loop {
                let word = self.next();
                if word.is_some_and(|word| word.eq_ignore_ascii_case(b"endsolid")) {
                    self.skip_line();
                    break;
                }
                if !word.is_some_and(|word| word.eq_ignore_ascii_case(b"facet")) {
                    return Err(self.wrong(word, "`facet` or `endsolid`"));
                }
                if triangles.len() == most {
                    return Err(MeshError::TooMany { most });
                }
                self.expect(&["normal"])?;
                // The normal is not used; some programs write `nan`.
                for _ in 0..3 {
                    let _ = self.next();
                }
                self.expect(&["outer", "loop"])?;
                let mut corners = Triangle::default();
                for corner in &mut corners {
                    self.expect(&["vertex"])?;
                    *corner = [self.coordinate()?, self.coordinate()?, self.coordinate()?];
                }
                self.expect(&["endloop", "endfacet"])?;
                triangles.push(corners);
            }
        }
        Ok(triangles)
    }
}

/// An OBJ's text with continued lines, which end in a backslash, in one line each.
fn without_continuations(content: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(content.len());
    let mut at = 0;
    while at < content.len() {
        let rest = &content[at..];
        let end = [b"\\\n".as_slice(), b"\\\r\n"].into_iter().find(|end| rest.starts_with(end));
        out.push(if end.is_some() { b' ' } else { rest[0] });
        at += end.map_or(1, <[u8]>::len);
    }
    out
}

/// Finds a face of an OBJ with fewer than three corners, which the reader would take for a line or a point.
fn short_face(content: &[u8]) -> Option<MeshError> {
    (1..).zip(content.split(|byte| *byte == b'\n')).find_map(|(line, text)| {
        let mut words = text.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let is_face = words.next() == Some(b"f");
        let corners = words.take_while(|word| !word.starts_with(b"#")).count();
        (is_face && corners < 3).then_some(MeshError::ShortFace { line, corners })
    })
}

fn obj(content: &[u8], most: usize) -> Result<Vec<Triangle>, MeshError> {
    let content = &*without_continuations(content);
    if let Some(error) = short_face(content) {
        return Err(error);
    }
    let options = tobj::LoadOptions {
        triangulate: true,
        ignore_points: true,
        ignore_lines: true,
        ..tobj::LoadOptions::default()
    };
    // Colours are in separate files, which are not needed.
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
                return Err(damaged(&"a face refers to a missing vertex"));
            };
            triangles.push([a, b, c]);
        }
    }
    Ok(triangles)
}
