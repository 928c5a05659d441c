//! Reads an arm's meshes, for the 3D view and X-ray frames, from the files that a scene names.

use std::collections::BTreeSet;
use std::path::PathBuf;

use crate::scene::closed_mesh::{ClosedMesh, MeshFault};
use crate::scene::mesh::{
    FARTHEST_M, MAX_MESH_BYTES, MOST_TRIANGLES, MeshError, MeshFormat, Triangle, triangles,
};
use crate::scene::{Arm, ArmMesh};
use crate::text_file;
use foreign_text::{foreign, foreign_path};
use xxhash_rust::xxh3::xxh3_128;

/// A mesh with its triangles.
#[derive(Debug, Clone, PartialEq)]
pub struct LoadedMesh<'a> {
    /// The mesh's entry in the scene.
    pub mesh: &'a ArmMesh,
    /// Its triangles, in the file's frame and unit.
    pub triangles: Vec<Triangle>,
}

/// Why a mesh of the arm is refused.
#[derive(Debug, thiserror::Error)]
#[error("`arm.mesh.file` {}, {fault}", of(.joint, .file))]
pub struct ArmMeshError {
    /// Joint that the mesh moves with; `None` for the arm's base.
    pub joint: Option<String>,
    /// The file.
    pub file: PathBuf,
    /// The defect.
    pub fault: ArmMeshFault,
}

/// A defect of one of the arm's meshes.
#[derive(Debug, thiserror::Error)]
pub enum ArmMeshFault {
    /// The file could not be read; holds the system's error.
    #[error("which cannot be read ({0}); expected an STL or OBJ file of at most {MAX_MESH_BYTES} bytes")]
    Unreadable(std::io::Error),
    /// Not a mesh, or an invalid one.
    #[error("which {0}")]
    Refused(MeshError),
    /// The file differs from the one that earlier X-ray frames were rendered with.
    #[error(
        "which has changed: its XXH3-128 is {found}, expected {expected} (`arm.mesh.file_xxh3`); X-ray \
         frames show it, so restore the original file or remove the key"
    )]
    Changed {
        /// Digest of the present file.
        found: String,
        /// Digest of the original file.
        expected: String,
    },
    /// Not a closed surface, so a ray's length inside it is undefined.
    #[error(
        "which {0}: X-ray frames need closed meshes; repair the file, or omit `arm.xray_density_g_per_cm3` \
         to leave the arm out of X-ray frames"
    )]
    NotSolid(MeshFault),
    /// Too large, most likely because it is in millimetres; holds its largest coordinate, m.
    #[error(
        "which extends {0:.1} m from its frame's origin, expected at most {FARTHEST_M} m; for a file in \
         millimetres set `arm.mesh.scale` (URDF: `scale` of the mesh) to 0.001"
    )]
    Far(f64),
}

fn refuse(mesh: &ArmMesh, fault: ArmMeshFault) -> ArmMeshError {
    ArmMeshError { joint: mesh.joint.clone(), file: mesh.file.clone(), fault }
}

fn of(joint: &Option<String>, file: &std::path::Path) -> String {
    let file = foreign_path(file);
    match joint {
        Some(joint) => format!("of joint `{}` is {file}", foreign(joint)),
        None => format!("of the arm's base is {file}"),
    }
}

/// Reads all of an arm's drawable meshes, in the order of the scene.
///
/// # Errors
/// [`ArmMeshError`] for the first file that is missing or invalid, or if there are too many triangles in
/// total.
pub fn load(arm: &Arm) -> Result<Vec<LoadedMesh<'_>>, ArmMeshError> {
    let mut left = MOST_TRIANGLES;
    let mut loaded = Vec::new();
    for mesh in arm.mesh.iter().flatten() {
        let Some(format) = MeshFormat::of(&mesh.file) else { continue };
        let content = text_file::read_bytes(&mesh.file, MAX_MESH_BYTES);
        let content = content.map_err(|cause| refuse(mesh, ArmMeshFault::Unreadable(cause)))?;
        if let Some(expected) = mesh.file_xxh3.clone() {
            let found = digest(&content);
            if !found.eq_ignore_ascii_case(&expected) {
                return Err(refuse(mesh, ArmMeshFault::Changed { found, expected }));
            }
        }
        let triangles = triangles(&content, format, left);
        let triangles = triangles.map_err(|cause| refuse(mesh, ArmMeshFault::Refused(cause)))?;
        let corners = triangles.iter().flatten();
        let reach_m = corners
            .flat_map(|corner| (0..3).map(move |axis| (f64::from(corner[axis]) * mesh.scale[axis]).abs()))
            .fold(0.0, f64::max);
        if reach_m > FARTHEST_M {
            return Err(refuse(mesh, ArmMeshFault::Far(reach_m)));
        }
        left -= triangles.len();
        loaded.push(LoadedMesh { mesh, triangles });
    }
    Ok(loaded)
}

/// Returns the meshes that X-ray frames show, in the file's frame and unit; empty without
/// `arm.xray_density_g_per_cm3`.
///
/// # Errors
/// As [`load`]; also if a mesh is not closed.
pub fn solids(arm: &Arm) -> Result<Vec<(&ArmMesh, ClosedMesh)>, ArmMeshError> {
    if arm.xray_density_g_per_cm3.is_none() {
        return Ok(Vec::new());
    }
    let solid = |LoadedMesh { mesh, triangles }| match ClosedMesh::new(&triangles) {
        Ok(solid) => Ok((mesh, solid)),
        Err(fault) => Err(refuse(mesh, ArmMeshFault::NotSolid(fault))),
    };
    load(arm)?.into_iter().map(solid).collect()
}

/// Stores the digest of each file that X-ray frames show, so that a replay either shows the same meshes or
/// reports the change. Unreadable files are left for [`load`] to report.
pub fn note_content(arm: &mut Arm) {
    if arm.xray_density_g_per_cm3.is_none() {
        return;
    }
    for mesh in arm.mesh.iter_mut().flatten() {
        if mesh.file_xxh3.is_none() && MeshFormat::of(&mesh.file).is_some() {
            mesh.file_xxh3 =
                text_file::read_bytes(&mesh.file, MAX_MESH_BYTES).ok().map(|content| digest(&content));
        }
    }
}

fn digest(content: &[u8]) -> String {
    format!("{:032x}", xxh3_128(content))
}

/// Returns a warning for each mesh in an unsupported format, with what is drawn instead.
pub fn undrawn(arm: &Arm) -> Vec<String> {
    let is_read = |mesh: &&ArmMesh| MeshFormat::of(&mesh.file).is_some();
    let meshes = || arm.mesh.iter().flatten();
    let drawn: BTreeSet<Option<&String>> = meshes().filter(is_read).map(|mesh| mesh.joint.as_ref()).collect();
    let told = |mesh: &ArmMesh| {
        let instead = match drawn.contains(&mesh.joint.as_ref()) {
            true => "the link is drawn with its other meshes",
            false => "the link is drawn as a tube",
        };
        let in_frames = match arm.xray_density_g_per_cm3 {
            Some(_) => " and is missing from X-ray frames",
            None => "",
        };
        format!(
            "`arm.mesh.file` {}, an unsupported format: expected STL or OBJ; {instead}{in_frames}",
            of(&mesh.joint, &mesh.file)
        )
    };
    meshes().filter(|mesh| !is_read(mesh)).map(told).collect()
}
