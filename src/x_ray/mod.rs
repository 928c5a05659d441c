//! X-ray pictures of the command line: poses as users write them, and files.

pub mod files;
pub mod poses;
