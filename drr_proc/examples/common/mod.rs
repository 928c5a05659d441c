//! Shared by the examples: a continuum manipulator and a PNG writer.

use std::fs::File;
use std::io::BufWriter;

use xray::{Material, Tool, ToolPart};

/// Writes a mono16 image (rows from top to bottom) as an 8-bit greyscale PNG file.
pub fn write_png(
    path: &str,
    columns: u32,
    rows: u32,
    image: &[u16],
) -> Result<(), Box<dyn std::error::Error>> {
    let mut encoder = png::Encoder::new(BufWriter::new(File::create(path)?), columns, rows);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.write_header()?.write_image_data(&xray::display::to_8_bit(image))?;
    Ok(())
}

/// Positions along a continuum manipulator: `rigid_m` straight along the unit vector `ahead`, then 27 links of 1.2 mm
/// that turn toward the unit vector `side` by `bend_rad` in total.
pub fn backbone(
    base_m: [f64; 3],
    ahead: [f64; 3],
    side: [f64; 3],
    rigid_m: f64,
    bend_rad: f64,
) -> Vec<[f64; 3]> {
    let go = |p: [f64; 3], angle: f64, s: f64| {
        let (sine, cosine) = libm::sincos(angle);
        [0, 1, 2].map(|a| p[a] + s * (cosine * ahead[a] + sine * side[a]))
    };
    let mut points = vec![base_m, go(base_m, 0.0, rigid_m)];
    for link in 1..=27 {
        points.push(go(points[points.len() - 1], bend_rad * f64::from(link) / 27.0, 1.2e-3));
    }
    points
}

/// Nitinol tubes of 6/4 mm between the points, a steel cable of 2 mm in their lumen, a steel burr of 6.5 mm at the
/// end.
pub fn snake(points: &[[f64; 3]]) -> Tool {
    let mut parts = Vec::new();
    for pair in points.windows(2) {
        let (start_m, end_m) = (pair[0], pair[1]);
        parts.push(ToolPart::HollowCylinder {
            start_m,
            end_m,
            outer_radius_m: 3e-3,
            inner_radius_m: 2e-3,
            material: Material::Nitinol,
        });
        parts.push(ToolPart::Cylinder { start_m, end_m, radius_m: 1e-3, material: Material::Steel316L });
    }
    if let Some(&centre_m) = points.last() {
        parts.push(ToolPart::Sphere { centre_m, radius_m: 3.25e-3, material: Material::Steel316L });
    }
    Tool { parts, arm: None }
}
