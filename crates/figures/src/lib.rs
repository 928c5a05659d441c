//! Figures: axes, panels with curves and legends, texts, drawn to PNG and SVG without a font on the machine;
//! pictures as PNG.
//!
//! **Invariant:** the same shapes give the same bytes; texts of a figure that passes [`Figure::collisions`]
//! lie over nothing.

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

/// Why a file of a figure, or of what stands beside one, could not be written.
#[derive(Debug, thiserror::Error)]
pub enum FigureError {
    /// A file could not be written.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// The content of a file could not be made.
    #[error("{}: cannot be {what}: {cause}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What it cannot be, such as "drawn".
        what: &'static str,
        /// The reason of the library that makes it.
        cause: String,
    },
    /// The built-in font was refused.
    #[error(
        "the built-in font of the figures cannot be read by the drawing library; rebuild with the locked dependencies"
    )]
    Font,
}

impl FigureError {
    /// The content of a file could not be made, with the cause.
    pub fn content<C: ToString>(path: &Path, what: &'static str) -> impl FnOnce(C) -> FigureError {
        move |cause| FigureError::Content { path: path.into(), what, cause: cause.to_string() }
    }
}
