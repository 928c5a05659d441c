//! What the files of `[[structure]]` and `[[drr.object]]` hold, as text in the scene: voxels as
//! run lengths, surfaces as indexed triangles. The text may come from an untrusted log, so its sizes are
//! checked before memory is allocated.

use data_encoding::BASE64;

use crate::closed_mesh::ClosedMesh;
use crate::mesh::Triangle;
use crate::model::{FARTHEST_MM, Scene, Structure, StructureSurface, StructureVoxels};

/// Largest number of voxels of the distance fields of a scene's labels together, with the space around each.
pub const MAX_STRUCTURE_VOXELS: usize = 1 << 26;
/// Largest number of triangles of a scene's structures and X-ray objects together.
pub const MAX_STRUCTURE_TRIANGLES: usize = 100_000;
/// Width of the space around a label, to every side, in which distances from it are exact.
pub const FIELD_REACH_MM: f64 = 20.0;

impl StructureVoxels {
    /// Packs the voxels of the box of `dims` at `low` in which `is_inside` holds; `origin_mm` is the centre
    /// of the box's first voxel.
    pub fn pack(
        dims: [usize; 3],
        spacing_mm: [f64; 3],
        origin_mm: [f64; 3],
        axes: [[f64; 3]; 3],
        is_inside: impl Iterator<Item = bool>,
    ) -> StructureVoxels {
        let mut bytes = Vec::new();
        let (mut length, mut inside) = (0, false);
        for voxel in is_inside {
            if voxel != inside {
                put_number(&mut bytes, length);
                (length, inside) = (0, voxel);
            }
            length += 1;
        }
        put_number(&mut bytes, length);
        StructureVoxels { dims, spacing_mm, origin_mm, axes, runs: BASE64.encode(&bytes) }
    }

    /// Returns whether each voxel is inside, first axis fastest.
    ///
    /// # Errors
    /// The runs are malformed, or do not cover `dims`.
    pub fn is_inside(&self) -> Result<Vec<bool>, String> {
        let count = self.dims.into_iter().try_fold(1_usize, usize::checked_mul);
        let count = count.filter(|count| *count <= MAX_STRUCTURE_VOXELS).ok_or_else(|| {
            format!("has {:?} voxels; allowed: at most {MAX_STRUCTURE_VOXELS} in all", self.dims)
        })?;
        let malformed =
            || format!("has malformed `runs`; expected runs of {count} voxels as LEB128 in Base64");
        let bytes = BASE64.decode(self.runs.as_bytes()).map_err(|_| malformed())?;
        let (mut voxels, mut inside, mut rest) = (Vec::with_capacity(count), false, &bytes[..]);
        while let Some(length) = take_number(&mut rest) {
            if length > count - voxels.len() {
                return Err(malformed());
            }
            voxels.resize(voxels.len() + length, inside);
            inside = !inside;
        }
        if rest.is_empty() && voxels.len() == count && voxels.contains(&true) {
            Ok(voxels)
        } else {
            Err(malformed())
        }
    }

    /// Returns the number of voxels to add before and behind along each axis for the space in which distances
    /// are exact.
    pub fn grown_by(&self) -> [usize; 3] {
        self.spacing_mm.map(|spacing_mm| (FIELD_REACH_MM / spacing_mm).ceil() as usize)
    }

    /// Returns the number of voxels of the distance field; `None` if it overflows.
    fn field_voxels(&self) -> Option<usize> {
        let grown = self.grown_by();
        (0..3).try_fold(1_usize, |product, axis| {
            product.checked_mul(self.dims[axis].checked_add(grown[axis].checked_mul(2)?)?)
        })
    }
}

impl StructureSurface {
    /// Packs a closed mesh in LPS, mm.
    pub fn pack(mesh: &ClosedMesh) -> StructureSurface {
        let corners: Vec<u8> =
            mesh.corners().iter().flatten().flat_map(|x| (*x as f32).to_le_bytes()).collect();
        let triangles: Vec<u8> = mesh.triangles().iter().flatten().flat_map(|i| i.to_le_bytes()).collect();
        StructureSurface { corners: BASE64.encode(&corners), triangles: BASE64.encode(&triangles) }
    }

    /// Returns the closed mesh, LPS, mm.
    ///
    /// # Errors
    /// The text is malformed, or its triangles do not bound a solid.
    pub fn mesh(&self) -> Result<ClosedMesh, String> {
        if self.triangle_count() > MAX_STRUCTURE_TRIANGLES {
            return Err(format!("has more than {MAX_STRUCTURE_TRIANGLES} triangles; use a coarser mesh"));
        }
        let triangles = self.unpacked().ok_or("has a malformed `surface`; expected that of a mesh file")?;
        if let Some(far) =
            triangles.iter().flatten().flatten().find(|x| x.is_nan() || x.abs() > FARTHEST_MM as f32)
        {
            return Err(format!("has a coordinate of {far} mm; allowed: within {FARTHEST_MM} mm"));
        }
        ClosedMesh::new(&triangles).map_err(|fault| fault.to_string())
    }

    /// Number of triangles that the text's length allows for.
    fn triangle_count(&self) -> usize {
        self.triangles.len() / 4 * 3 / 12
    }

    fn unpacked(&self) -> Option<Vec<Triangle>> {
        let [corners, triangles] =
            [&self.corners, &self.triangles].map(|text| BASE64.decode(text.as_bytes()).ok());
        let (corners, triangles) = (corners?, triangles?);
        let (corners, []) = corners.as_chunks::<12>() else { return None };
        let (triangles, []) = triangles.as_chunks::<12>() else { return None };
        let corner = |index: u32| -> Option<[f32; 3]> {
            let bytes = corners.get(index as usize)?.as_chunks::<4>().0;
            Some([0, 1, 2].map(|axis| f32::from_le_bytes(bytes[axis])))
        };
        let triangle = |bytes: &[u8; 12]| -> Option<Triangle> {
            let [a, b, c] = [0, 1, 2].map(|at| corner(u32::from_le_bytes(bytes.as_chunks::<4>().0[at])));
            Some([a?, b?, c?])
        };
        triangles.iter().map(triangle).collect()
    }
}

impl Scene {
    /// Checks what was read from the files of `[[structure]]` and `[[drr.object]]`; as an error, the
    /// key and the problem.
    ///
    /// # Errors
    /// Content is malformed, or there is too much of it.
    pub fn check_structure_content(&self) -> Result<(), (String, String)> {
        let mut voxels = 0_usize;
        for Structure { name, label, .. } in &self.structure {
            if let Some(content) = label.as_ref().and_then(|label| label.voxels.as_ref()) {
                let refuse = |problem: String| (format!("structure `{name}`.label"), problem);
                voxels = content.field_voxels().unwrap_or(usize::MAX).saturating_add(voxels);
                if voxels > MAX_STRUCTURE_VOXELS {
                    return Err(refuse(format!(
                        "needs {voxels} voxels for distances up to {FIELD_REACH_MM} mm around the labels so far; \
                         allowed: {MAX_STRUCTURE_VOXELS}; use coarser label maps"
                    )));
                }
                content.is_inside().map_err(refuse)?;
            }
        }
        let structures = self.structure.iter().map(|it| ("structure", &it.name, it.mesh.as_ref()));
        let objects = self.drr.iter().flat_map(|drr| &drr.object);
        let objects = objects.map(|it| ("drr.object", &it.name, it.mesh.as_ref()));
        let mut triangles = 0;
        for (table, name, mesh) in structures.chain(objects) {
            let Some(surface) = mesh.and_then(|mesh| mesh.surface.as_ref()) else { continue };
            let refuse = |problem: String| (format!("{table} `{name}`.mesh"), problem);
            triangles += surface.triangle_count();
            if triangles > MAX_STRUCTURE_TRIANGLES {
                return Err(refuse(format!(
                    "has, with the meshes before it, {triangles} triangles; allowed: \
                     {MAX_STRUCTURE_TRIANGLES}; use coarser meshes"
                )));
            }
            surface.mesh().map_err(refuse)?;
        }
        Ok(())
    }
}

/// Appends a number as LEB128.
fn put_number(bytes: &mut Vec<u8>, mut number: usize) {
    while number > 0x7f {
        bytes.push(number as u8 | 0x80);
        number >>= 7;
    }
    bytes.push(number as u8);
}

/// Takes a number of at most 35 bits from the front; `None` if there is no complete one.
fn take_number(rest: &mut &[u8]) -> Option<usize> {
    let last = rest.iter().take(5).position(|byte| byte & 0x80 == 0)?;
    let (bytes, after) = rest.split_at(last + 1);
    *rest = after;
    Some(bytes.iter().rev().fold(0, |number, byte| number << 7 | usize::from(byte & 0x7f)))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by it")]
mod tests {
    use super::*;

    const AXES: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

    fn packed(dims: [usize; 3], is_inside: &[bool]) -> StructureVoxels {
        StructureVoxels::pack(dims, [0.5; 3], [1.0, 2.0, 3.0], AXES, is_inside.iter().copied())
    }

    #[test]
    fn voxels_come_back_as_they_were_and_others_are_refused() {
        let dims = [40, 30, 20];
        let ball = |index: usize| {
            let [x, y, z] = [index % 40, index / 40 % 30, index / 1200].map(|x| x as f64);
            (x - 20.0).hypot(y - 15.0).hypot(z - 10.0) < 9.5
        };
        let voxels: Vec<bool> = (0..24_000).map(ball).collect();
        let text = packed(dims, &voxels);
        assert_eq!(text.is_inside().unwrap(), voxels);
        assert!(text.runs.len() < 2500, "{}", text.runs.len());
        // All inside: the first run has length 0.
        assert_eq!(packed([3, 1, 1], &[true; 3]).is_inside().unwrap(), [true; 3]);
        for changed in [
            StructureVoxels { dims: [40, 30, 21], ..text.clone() },
            StructureVoxels { dims: [40, 30, 19], ..text.clone() },
            StructureVoxels { runs: "A".to_owned(), ..text.clone() },
            StructureVoxels { runs: BASE64.encode(&[0x80]), ..text.clone() },
            StructureVoxels { dims: [usize::MAX; 3], ..text.clone() },
            packed([3, 1, 1], &[false; 3]),
        ] {
            assert!(changed.is_inside().is_err(), "{changed:?}");
        }
    }

    #[test]
    fn a_surface_comes_back_as_it_was_and_an_open_one_is_refused() {
        let corners = [[0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [0.0, 2.5, 0.0], [0.0, 0.0, 3.5]];
        let faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        let triangles: Vec<Triangle> = faces.iter().map(|face| face.map(|i: usize| corners[i])).collect();
        let mesh = ClosedMesh::new(&triangles).unwrap();
        let text = StructureSurface::pack(&mesh);
        assert_eq!(text.mesh().unwrap(), mesh);
        let cut = StructureSurface { triangles: text.triangles[..48].to_owned(), ..text.clone() };
        assert!(cut.mesh().unwrap_err().contains("is not closed"));
        let lost = StructureSurface { corners: text.corners[..32].to_owned(), ..text };
        assert!(lost.mesh().unwrap_err().contains("malformed"));
    }
}
