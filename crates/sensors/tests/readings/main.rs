//! Readings of every kind of sensor, in one program: it is linked once, and its tests run on all cores.

mod common;
mod errors;
mod shape;
mod timing;
