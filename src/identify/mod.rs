//! Results of an identification as text, figures and one page.

mod figure;
mod page;
mod text;

pub use page::html;
pub use text::{check_text, design_text, fit_text};
