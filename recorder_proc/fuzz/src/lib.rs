//! Fuzz targets of the log reader, the repair and the scene reader.

pub mod targets;
