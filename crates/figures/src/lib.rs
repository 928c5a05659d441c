//! Figures with axes, panels, curves, legends and text, drawn to PNG and SVG without fonts on the machine;
//! and pictures as PNG.
//!
//! **Invariant:** the same shapes give the same bytes; texts of a figure that passes [`Figure::collisions`]
//! do not overlap.

mod axis;
mod collisions;
mod panel;
pub mod picture;
mod shapes;

use std::path::{Path, PathBuf};

use output_file::OutputError;
pub use plotters::style::{BLACK, RGBColor, WHITE};

pub use axis::{Axis, bounds, count_label, duration_label};
pub use panel::{COLOURS, DASHES, EDGES, INK, Key, Panel, Rect, clip};
pub use shapes::{Anchor, Figure, HEAD, Point, Shape, Stroke, TextSize, WIDTH, text_width};

/// Errors of writing a figure or an accompanying file.
#[derive(Debug, thiserror::Error)]
pub enum FigureError {
    /// A file could not be written.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// The content of a file could not be created.
    #[error("{}: cannot be {what}: {cause}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// The failed operation, such as "drawn".
        what: &'static str,
        /// The library's error.
        cause: String,
    },
    /// The built-in font was rejected.
    #[error(
        "the drawing library cannot read the built-in font of the figures; rebuild with the locked \
         dependencies"
    )]
    Font,
}

impl FigureError {
    /// Returns a constructor for content errors of a file.
    pub fn content<C: ToString>(path: &Path, what: &'static str) -> impl FnOnce(C) -> FigureError {
        move |cause| FigureError::Content { path: path.into(), what, cause: cause.to_string() }
    }
}
