//! Geometry of a run for export: the tunnel, the tool, the burr's path and its deviation from the plan.
//! Patient frame (LPS), mm.
//!
//! **Boundary:** numbers in, numbers and bytes out; commands open and write the files.

pub mod mesh;
pub mod mesh_files;
pub mod path;
pub mod tool;
pub mod tunnel;

pub use mesh::Mesh;
