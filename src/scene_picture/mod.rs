//! A picture of a scene before its run: CT slices through the entry and the target with the planned path,
//! pilot hole and tool to scale, Hounsfield units along the path, and measurements.
//!
//! | module | contents |
//! |---|---|
//! | [`shape`] | geometry drawn into the CT: pilot holes, path, tool at the start and end |
//! | [`surroundings`] | distances to the surface of the bone |
//! | [`scale`] | lengths that follow from the size of the volume |
//! | [`facts`] | measurements |
//! | [`mod@slice`] | a plane through the CT as pixels |
//! | [`figure`] | the picture |

pub mod facts;
pub mod figure;
pub mod scale;
pub mod shape;
pub mod slice;
pub mod surroundings;

/// Converts millimetres to metres.
fn metres([x, y, z]: [f64; 3]) -> [f64; 3] {
    [x * 1e-3, y * 1e-3, z * 1e-3]
}
