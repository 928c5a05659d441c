//! The pure core of `drr_proc` against closed forms, tables and itself.
//!
//! The modules are `cfg(test)` so that clippy knows their helpers for tests, which may unwrap.

#[cfg(test)]
mod attenuation;
#[cfg(test)]
mod camera;
#[cfg(test)]
mod detector;
#[cfg(test)]
mod frames;
#[cfg(test)]
mod geometry;
#[cfg(test)]
mod ladder;
#[cfg(test)]
mod poses;
#[cfg(test)]
mod projectors;
#[cfg(test)]
mod slice_ordered;
#[cfg(test)]
mod spectrum;
#[cfg(test)]
mod tool;
