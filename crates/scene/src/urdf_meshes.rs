//! Meshes of the links of a URDF file: those of `visual`, or of `collision` where none of the former can be
//! drawn.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use foreign_text::{foreign, foreign_path};
use roxmltree::Node;
use toml::{Table, Value};

use crate::mesh::MeshFormat;
use crate::named_file::{ReadText, numbers};
use crate::urdf::{FARTHEST_M, GREATEST_RAD, child, three};

/// Largest scale factor of a mesh, m per file unit.
const GREATEST_SCALE: f64 = 1e3;

/// Where mesh files are searched.
pub(crate) struct MeshPlaces<'a> {
    /// Folder of the URDF file, absolute.
    pub(crate) folder: &'a Path,
    /// Probes whether a file exists.
    pub(crate) read: &'a ReadText<'a>,
}

/// The meshes of one link, each as a table of `arm.mesh` that moves with `joint`.
///
/// # Errors
/// A file that is missing, or malformed numbers; the message names the link.
pub(crate) fn of_link(link: Node, joint: Option<&str>, places: &MeshPlaces) -> Result<Vec<Value>, String> {
    let name = link.attribute("name").unwrap_or_default();
    let of = |kind: &'static str| -> Vec<Mesh> {
        link.children().filter(|node| node.has_tag_name(kind)).filter_map(Mesh::of).collect()
    };
    let mut meshes = of("visual");
    if !meshes.iter().any(|mesh| MeshFormat::of(Path::new(mesh.file)).is_some()) {
        meshes.extend(of("collision"));
    }
    let table =
        |mesh: &Mesh| mesh.table(joint, places).map_err(|what| format!("link `{}` {what}", foreign(name)));
    meshes.iter().map(table).collect()
}

/// A mesh element of the file.
struct Mesh<'a> {
    file: &'a str,
    scale: Option<&'a str>,
    origin: Option<Node<'a, 'a>>,
}

impl<'a> Mesh<'a> {
    /// The mesh of a `visual` or a `collision`; `None` if its geometry is a box, a cylinder or a sphere.
    fn of(node: Node<'a, 'a>) -> Option<Mesh<'a>> {
        let mesh = child(node, "geometry").and_then(|node| child(node, "mesh"))?;
        let file = mesh.attribute("filename")?;
        Some(Mesh { file, scale: mesh.attribute("scale"), origin: child(node, "origin") })
    }

    fn table(&self, joint: Option<&str>, places: &MeshPlaces) -> Result<Value, String> {
        let place = |key: &str, most: f64| match self.origin.and_then(|node| node.attribute(key)) {
            None => Ok([0.0; 3]),
            Some(text) => three("origin", key, text, most),
        };
        let file = places.found(self.file)?;
        let file = file
            .to_str()
            .ok_or_else(|| format!("has the mesh {}, whose path is not UTF-8", foreign_path(&file)))?;
        let scale = self.scale.map_or(Ok([1.0; 3]), |text| three("mesh", "scale", text, GREATEST_SCALE))?;
        let mut table = Table::new();
        if let Some(joint) = joint {
            table.insert("joint".to_owned(), Value::String(joint.to_owned()));
        }
        table.insert("file".to_owned(), Value::String(file.to_owned()));
        table.insert("position_mm".to_owned(), numbers(place("xyz", FARTHEST_M)?.map(|m| m * 1e3)));
        table.insert(
            "roll_pitch_yaw_deg".to_owned(),
            numbers(place("rpy", GREATEST_RAD)?.map(f64::to_degrees)),
        );
        table.insert("scale".to_owned(), numbers(scale));
        Ok(Value::Table(table))
    }
}

impl MeshPlaces<'_> {
    /// Resolves a file name: `package://NAME/PATH` is `NAME/PATH` in the URDF file's folder or in one above
    /// it, as in a ROS workspace.
    fn found(&self, name: &str) -> Result<PathBuf, String> {
        // Reading only tests for existence: most meshes are not text.
        let is_there = |path: &PathBuf| match (self.read)(path) {
            Ok(_) => true,
            Err(cause) => !matches!(cause.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory),
        };
        let (found, expected) = match name.split_once("://") {
            Some(("package", path)) => {
                let found = self.folder.ancestors().map(|above| above.join(path)).find(is_there);
                (found, format!("{} in {} or in a folder above it", foreign(path), foreign_path(self.folder)))
            }
            Some((kind, _)) if kind != "file" => {
                let (name, kind) = (foreign(name), foreign(kind));
                return Err(format!(
                    "has the mesh {name} with the unsupported scheme `{kind}`, expected `package://`, \
                     `file://` or a path"
                ));
            }
            Some((_, path)) => (Some(PathBuf::from(path)).filter(is_there), foreign(path).to_string()),
            None => {
                let path = self.folder.join(name);
                let expected = foreign_path(&path);
                (Some(path).filter(is_there), expected)
            }
        };
        found.ok_or_else(|| {
            format!(
                "has the mesh {}, which was not found; expected {expected}; `arm.meshes = false` draws tubes \
                 instead",
                foreign(name)
            )
        })
    }
}
