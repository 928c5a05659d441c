//! A scene before its run, as one picture: CT slices through the burr's start, the entry and the target, the
//! planned path with its pilot hole, the tool to scale, Hounsfield units along the path, and what is measured
//! there.
//!
//! | module | what it holds |
//! |---|---|
//! | [`shape`] | what is drawn into the CT: the pilot holes, the path, the tool at the start and at the end of the path |
//! | [`surroundings`] | where the bone ends: distances from the path |
//! | [`facts`] | the figures |
//! | [`mod@slice`] | a plane through the CT as pixels |
//! | [`figure`] | the picture |

pub mod facts;
pub mod figure;
pub mod shape;
pub mod slice;
pub mod surroundings;

/// Metres of millimetres.
fn metres([x, y, z]: [f64; 3]) -> [f64; 3] {
    [x * 1e-3, y * 1e-3, z * 1e-3]
}
