//! Geometry of an NRRD file: units, space, directions, origin.

use super::axes::Axes;
use super::header::Header;
use crate::error::{Field, VolumeError};
use crate::text_header::{numbers, unit_of_length, wrong};
use crate::volume::{GeometryFields, StatedGeometry, columns, norm, placement};
use voxel_grid::Placement;

/// Directions of the spatial axes, as signs that convert the file's space to LPS.
struct Space {
    to_lps: [f64; 3],
    name: String,
}

const NAMES: GeometryFields =
    GeometryFields { spacing: "spacings", direction: "space directions", origin: "space origin" };
const NO_UNIT: &str = "mm (assumed: not stated in the file)";

impl Header<'_> {
    /// Metres per unit of length; all three axes must agree.
    pub(super) fn unit(&self, axes: &Axes) -> Result<(f64, String), VolumeError> {
        // `space units` holds one quoted name per axis; `units` is its counterpart in files without a space.
        let Some((field, text)) = ["space units", "units"].iter().find_map(|f| self.get(f).map(|t| (*f, t)))
        else {
            return Ok((1e-3, NO_UNIT.into()));
        };
        let all: Vec<&str> = if text.contains('"') {
            text.split('"').skip(1).step_by(2).collect()
        } else {
            text.split_whitespace().collect()
        };
        let names = axes.pick(&all).map_or(all, |three| three.to_vec());
        let first = names.first().copied().unwrap_or("");
        if names.iter().all(|name| name.trim().is_empty()) {
            return Ok((1e-3, NO_UNIT.into()));
        }
        let expected = "the same unit of length for every axis: m, cm, mm or um";
        if names.iter().any(|name| *name != first) {
            return Err(self.unsupported(field, text, expected));
        }
        let (unit_m, name) = unit_of_length(first).ok_or_else(|| self.unsupported(field, text, expected))?;
        Ok((unit_m, name.into()))
    }

    fn space(&self, notes: &mut Vec<String>) -> Result<Space, VolumeError> {
        let Some(name) = self.get("space") else {
            if let Some(rank) = self.get("space dimension").filter(|rank| *rank != "3") {
                return Err(wrong(self.path, "space dimension", rank, "3"));
            }
            notes.push("no space given; assuming left, posterior, superior".into());
            return Ok(Space { to_lps: [1.0; 3], name: "none".into() });
        };
        let lower = name.to_lowercase();
        let words: Vec<&str> = match lower.as_str() {
            "ras" => vec!["right", "anterior", "superior"],
            "las" => vec!["left", "anterior", "superior"],
            "lps" => vec!["left", "posterior", "superior"],
            // Spaces without a patient; ITK, and therefore Slicer, reads their coordinates as LPS.
            "scanner-xyz" | "3d-right-handed" | "3drh" => {
                notes.push(format!(
                    "the space `{lower}` is not anatomical; assuming left, posterior, superior"
                ));
                vec!["left", "posterior", "superior"]
            }
            // Any combination of the six directions in patient order (x, y, z) is unambiguous.
            other => other.split('-').collect(),
        };
        let signs = match words.as_slice() {
            [x @ ("right" | "left"), y @ ("anterior" | "posterior"), z @ ("superior" | "inferior")] => {
                [*x == "right", *y == "anterior", *z == "inferior"]
            }
            _ => {
                let expected = "left-posterior-superior, right-anterior-superior or left-anterior-superior";
                return Err(self.unsupported("space", name, expected));
            }
        };
        Ok(Space { to_lps: signs.map(|flipped| if flipped { -1.0 } else { 1.0 }), name: lower })
    }

    pub(super) fn geometry(
        &self,
        axes: &Axes,
        unit_m: f64,
        notes: &mut Vec<String>,
    ) -> Result<Placement, VolumeError> {
        let space = self.space(notes)?;
        let flip = |v: [f64; 3]| [0, 1, 2].map(|i| space.to_lps[i] * v[i]);
        if let Some(text) = self.get("space directions") {
            let origin = match self.get("space origin") {
                Some(text) => self.vector("space origin", text)?,
                None => {
                    notes.push("no origin given; assuming (0, 0, 0)".into());
                    [0.0; 3]
                }
            };
            let origin_m = flip(origin).map(|o| o * unit_m);
            let vectors = self.directions(axes, text)?.map(flip);
            let names = GeometryFields { spacing: "space directions", ..NAMES };
            let spacing_m = vectors.map(|a| norm(a) * unit_m);
            let stated = StatedGeometry { spacing_m, origin_m, axes: vectors };
            return placement(self.path, names, stated, notes);
        }
        let spacing = match self.get("spacings") {
            Some(text) => self.per_axis(axes, "spacings", text)?,
            // As other readers do.
            None => {
                notes.push(format!("no `spacings` given; assuming voxels of {} mm", unit_m * 1e3));
                [1.0; 3]
            }
        };
        let origin = match self.get("space origin") {
            Some(text) => self.vector("space origin", text)?,
            None => self.axis_minima(axes, spacing, notes)?,
        };
        if space.name != "none" {
            notes.push("no space directions given; assuming the axes of the space".into());
        }
        let [x, y, z] = space.to_lps;
        let along = columns([[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]]);
        let origin_m = flip(origin).map(|o| o * unit_m);
        let stated = StatedGeometry { spacing_m: spacing.map(|s| s * unit_m), origin_m, axes: along };
        placement(self.path, NAMES, stated, notes)
    }

    /// The spatial axes' vectors, in the file's space and unit.
    fn directions(&self, axes: &Axes, text: &str) -> Result<[[f64; 3]; 3], VolumeError> {
        let spacings = self.get("spacings").unwrap_or("");
        if !spacings.to_lowercase().split_whitespace().all(|w| w == "nan") {
            return Err(wrong(
                self.path,
                "spacings",
                spacings,
                "no `spacings` together with `space directions`",
            ));
        }
        let expected = "three vectors such as (1,0,0) (0,1,0) (0,0,1)";
        let texts = axes.pick(&split_vectors(text));
        let texts = texts.ok_or_else(|| wrong(self.path, "space directions", text, expected))?;
        let mut vectors = [[0.0; 3]; 3];
        for (vector, text) in vectors.iter_mut().zip(&texts) {
            *vector = self.vector("space directions", text)?;
        }
        if vectors.iter().any(|a| !norm(*a).is_finite() || norm(*a) == 0.0) {
            return Err(VolumeError::SingularDirection(Field::new(self.path, "space directions", text)));
        }
        Ok(vectors)
    }

    /// Origin of a file without a space: `axis mins`, or zero. For cell-centred axes (the default) the
    /// minimum is the outer face of the first cell; for `node` axes it is the first sample (Definition of
    /// NRRD, "axis mins" and "centers"; teem's nrrdOriginCalculate, which ITK calls).
    fn axis_minima(
        &self,
        axes: &Axes,
        spacing: [f64; 3],
        notes: &mut Vec<String>,
    ) -> Result<[f64; 3], VolumeError> {
        let Some(text) = self.get("axis mins").filter(|text| !text.to_lowercase().contains("nan")) else {
            notes.push("no origin given; assuming (0, 0, 0)".into());
            return Ok([0.0; 3]);
        };
        let minima = self.per_axis(axes, "axis mins", text)?;
        let centers: Vec<&str> = self.get("centers").unwrap_or("").split_whitespace().collect();
        let centers = axes.pick(&centers).unwrap_or(["cell"; 3]);
        notes.push("origin from `axis mins`: the outer face of cells, or the centre of nodes".into());
        Ok([0, 1, 2].map(|i| minima[i] + if centers[i] == "node" { 0.0 } else { 0.5 * spacing[i] }))
    }

    /// The spatial entries of a field with one number per axis; other axes may have `nan`.
    fn per_axis(&self, axes: &Axes, field: &str, text: &str) -> Result<[f64; 3], VolumeError> {
        let words: Vec<&str> = text.split_whitespace().collect();
        match axes.pick(&words) {
            Some(three) if words.len() > 3 => numbers::<3>(self.path, field, &three.join(" ")),
            _ => numbers::<3>(self.path, field, text),
        }
    }

    fn vector(&self, field: &str, text: &str) -> Result<[f64; 3], VolumeError> {
        let inner = text.trim().strip_prefix('(').and_then(|t| t.strip_suffix(')'));
        let inner = inner.ok_or_else(|| wrong(self.path, field, text, "a vector such as (1,0,0)"))?;
        numbers::<3>(self.path, field, inner)
    }
}

/// Splits `(1,0,0) (0,1,0) none` into its entries; spaces inside parentheses do not split.
pub(super) fn split_vectors(text: &str) -> Vec<String> {
    let mut out: Vec<String> = Vec::new();
    let mut depth = 0_usize;
    let mut fresh = true;
    for c in text.chars() {
        if c.is_whitespace() && depth == 0 {
            fresh = true;
            continue;
        }
        depth = match c {
            '(' => depth + 1,
            ')' => depth.saturating_sub(1),
            _ => depth,
        };
        if fresh {
            out.push(String::new());
            fresh = false;
        }
        if let Some(entry) = out.last_mut() {
            entry.push(c);
        }
    }
    out
}
