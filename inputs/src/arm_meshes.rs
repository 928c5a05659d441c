//! The meshes that the arm is drawn with, read from the files that a scene names.

use std::collections::BTreeSet;
use std::path::PathBuf;

use foreign_text::{foreign, foreign_path};
use ipc_types::scene::mesh::{
    FARTHEST_M, MAX_MESH_BYTES, MOST_TRIANGLES, MeshError, MeshFormat, Triangle, triangles,
};
use ipc_types::scene::{Arm, ArmMesh};
use ipc_types::text_file;

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
pub enum ArmMeshError {
    /// The system's reason.
    #[error("`arm.mesh.file` {}, which cannot be read ({cause}); expected an STL or OBJ file of at most {MAX_MESH_BYTES} bytes", of(.joint, .file))]
    Unreadable {
        /// Joint with which it moves; none: the arm's base.
        joint: Option<String>,
        /// The file.
        file: PathBuf,
        /// Reason.
        cause: std::io::Error,
    },
    /// It is no mesh, or holds what none may.
    #[error("`arm.mesh.file` {}, which {cause}", of(.joint, .file))]
    Refused {
        /// Joint with which it moves; none: the arm's base.
        joint: Option<String>,
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        cause: MeshError,
    },
    /// Most likely in millimetres.
    #[error(
        "`arm.mesh.file` {}, which reaches {reach_m:.1} m from its own frame, expected {FARTHEST_M} m at most: `arm.mesh.scale` (URDF: `scale` of \
         the mesh) is 0.001 for a file in millimetres", of(.joint, .file)
    )]
    Far {
        /// Joint with which it moves; none: the arm's base.
        joint: Option<String>,
        /// The file.
        file: PathBuf,
        /// Largest coordinate, m.
        reach_m: f64,
    },
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
        let (joint, file) = (mesh.joint.clone(), mesh.file.clone());
        let content = match text_file::read_bytes(&mesh.file, MAX_MESH_BYTES) {
            Ok(content) => content,
            Err(cause) => return Err(ArmMeshError::Unreadable { joint, file, cause }),
        };
        let triangles = match triangles(&content, format, left) {
            Ok(triangles) => triangles,
            Err(cause) => return Err(ArmMeshError::Refused { joint, file, cause }),
        };
        let corners = triangles.iter().flatten();
        let reach_m = corners
            .flat_map(|corner| (0..3).map(move |axis| (f64::from(corner[axis]) * mesh.scale[axis]).abs()))
            .fold(0.0, f64::max);
        if reach_m > FARTHEST_M {
            return Err(ArmMeshError::Far { joint, file, reach_m });
        }
        left -= triangles.len();
        loaded.push(LoadedMesh { mesh, triangles });
    }
    Ok(loaded)
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
        format!(
            "`arm.mesh.file` {}, which is not drawn: expected STL or OBJ; {instead}",
            of(&mesh.joint, &mesh.file)
        )
    };
    meshes().filter(|mesh| !is_read(mesh)).map(told).collect()
}
