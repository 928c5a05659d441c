//! 3D Slicer markups (points, lines and curves placed in a CT), and the drilling plan that they define.
//!
//! Sources: the JSON schema of `.mrk.json`, markups-schema-v1.0.3 (github.com/Slicer/Slicer,
//! Modules/Loadable/Markups/Resources/Schema); `.fcsv`, the older format for points alone, is described in
//! Slicer's user guide, "Markups module, file format".
//!
//! [`read`] takes the text of either and returns [`Markup`]s; [`Plan::of`] finds the points named entry, bend
//! and target in them; [`curve_json`] and [`points_fcsv`] write what Slicer opens.
//!
//! **Boundary:** text in, values out; no files. **Invariants:** a file's frame is read, never assumed: a file
//! that states neither LPS nor RAS is refused; every returned position is in LPS, finite and within 100 m; a
//! [`Plan`] has a direction and a target ahead of it.
//!
//! ```
//! use markups::{Plan, read};
//!
//! let text = r#"{"markups": [{"type": "Line", "coordinateSystem": "RAS", "controlPoints": [
//!     {"label": "entry", "position": [0, 0, 0]}, {"label": "target", "position": [30, 0, 0]}]}]}"#;
//! let plan = Plan::of(&read(text)?)?;
//! // RAS has x toward the right, LPS toward the left.
//! assert_eq!(plan.target_mm(), [-30.0, 0.0, 0.0]);
//! assert_eq!(plan.direction(), [-1.0, 0.0, 0.0]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod error;
mod fcsv;
mod markup;
mod mrk_json;
mod plan;
pub mod vector;
mod write;

pub use error::{MarkupsError, PlanError};
pub use markup::{FARTHEST_MM, Frame, Kind, Markup, Point, read};
pub use plan::{Arc, Plan};
pub use write::{curve_json, points_fcsv};
