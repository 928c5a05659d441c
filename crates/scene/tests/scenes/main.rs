//! Tests of scenes, plans, meshes and URDF in one program, which is linked once and shares both cores.

mod closed_meshes;
mod meshes;
mod plan;
mod relations;
mod tools;
mod urdf;
