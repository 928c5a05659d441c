//! Scenes, plans, meshes and URDF, in one program: it is linked once, and its tests share both cores.

mod closed_meshes;
mod meshes;
mod plan;
mod relations;
mod tools;
mod urdf;
