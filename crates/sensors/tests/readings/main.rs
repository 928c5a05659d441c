//! Readings of every kind of sensor, in one program: it is linked once, and its tests share both cores.

mod common;
mod errors;
mod shape;
mod timing;
