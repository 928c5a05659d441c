//! The meshes of an arm, for the 3D view and for X-ray frames, read from the files that a scene names.

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
    /// What the scene says about it.
    pub mesh: &'a ArmMesh,
    /// Its triangles, in the file's frame and unit.
    pub triangles: Vec<Triangle>,
}

/// Why a mesh of the arm is refused.
#[derive(Debug, thiserror::Error)]
#[error("`arm.mesh.file` {}, {fault}", of(.joint, .file))]
pub struct ArmMeshError {
    /// Joint with which it moves; none: the arm's base.
    pub joint: Option<String>,
    /// The file.
    pub file: PathBuf,
    /// What is wrong with it.
    pub fault: ArmMeshFault,
}

/// What is wrong with a mesh of the arm.
#[derive(Debug, thiserror::Error)]
pub enum ArmMeshFault {
    /// The system's reason.
    #[error("which cannot be read ({0}); expected an STL or OBJ file of at most {MAX_MESH_BYTES} bytes")]
    Unreadable(std::io::Error),
    /// Not a mesh, or an invalid one.
    #[error("which {0}")]
    Refused(MeshError),
    /// X-ray frames were rendered with another file of this name.
    #[error(
        "whose content has the XXH3-128 {found}, expected {expected} (`arm.mesh.file_xxh3`): X-ray frames show it, so put the file of \
         that time there, or leave the key out"
    )]
    Changed {
        /// Of the file that is there.
        found: String,
        /// Of the file that was there.
        expected: String,
    },
    /// A ray through it has no length in it.
    #[error(
        "which {0}: X-ray frames need closed meshes; repair the file, or leave `arm.xray_density_g_per_cm3` out, which shows no arm there"
    )]
    NotSolid(MeshFault),
    /// Most likely in millimetres; holds its largest coordinate, m.
    #[error(
        "which reaches {0:.1} m from its own frame, expected {FARTHEST_M} m at most: `arm.mesh.scale` (URDF: `scale` of the mesh) is \
         0.001 for a file in millimetres"
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

/// Reads all meshes of an arm that can be drawn, in the order of the scene.
///
/// # Errors
/// [`ArmMeshError`]: the first that is not there or is broken; too many triangles in all.
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

/// The meshes that X-ray frames show, in the file's frame and unit; none without
/// `arm.xray_density_g_per_cm3`.
///
/// # Errors
/// As [`load`]; a mesh that is not closed.
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

/// Notes what is in the files that X-ray frames show, so that a replay shows the same or says why not. Files
/// that cannot be read are left to [`load`].
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

/// A text for each mesh of a kind that is not read: what it is, and what is drawn instead.
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
            Some(_) => ", and X-ray frames lack it",
            None => "",
        };
        format!(
            "`arm.mesh.file` {}, which is not drawn: expected STL or OBJ; {instead}{in_frames}",
            of(&mesh.joint, &mesh.file)
        )
    };
    meshes().filter(|mesh| !is_read(mesh)).map(told).collect()
}
