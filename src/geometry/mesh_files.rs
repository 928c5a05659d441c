//! Writers for meshes and curves: STL, OBJ, and VTK PolyData as XML (`.vtp`).
//!
//! Sources: "The StL Format" (fabbers.com/tech/STL_Format, 1989) for binary STL; Wavefront's "Object files
//! (.obj)"; VTK's "File formats for VTK version 4.2", XML formats. Implemented here because each is twenty
//! lines, and the crates that write `.vtp` were last released in 2021. 3D Slicer distinguishes LPS from RAS
//! files by `SPACE=LPS`.

use std::fmt::Write;

use markups::vector::{cross, length, minus};

use super::mesh::Mesh;

/// Encodes binary STL: single precision, no shared vertices.
pub fn stl(mesh: &Mesh) -> Vec<u8> {
    let mut header = [b' '; 80];
    let text = b"Trabecula, mm, SPACE=LPS";
    header[..text.len()].copy_from_slice(text);
    let mut bytes = header.to_vec();
    bytes.extend((mesh.triangles.len() as u32).to_le_bytes());
    for triangle in &mesh.triangles {
        let corners = mesh.corners_mm(*triangle);
        let [a, b, c] = corners;
        let normal = cross(minus(b, a), minus(c, a));
        let length = length(normal);
        let normal = if length > 0.0 { normal.map(|x| x / length) } else { normal };
        for number in normal.iter().chain(corners.iter().flatten()) {
            bytes.extend((*number as f32).to_le_bytes());
        }
        bytes.extend([0, 0]);
    }
    bytes
}

/// Encodes Wavefront OBJ.
pub fn obj(mesh: &Mesh) -> String {
    let mut text = "# Trabecula, mm, SPACE=LPS\n".to_owned();
    for [x, y, z] in &mesh.points_mm {
        let _ = writeln!(text, "v {x:?} {y:?} {z:?}");
    }
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|corner| corner + 1);
        let _ = writeln!(text, "f {a} {b} {c}");
    }
    text
}

/// Encodes a mesh as VTK PolyData.
pub fn vtp(mesh: &Mesh) -> String {
    let cells: Vec<&[u32]> = mesh.triangles.iter().map(<[u32; 3]>::as_slice).collect();
    poly_data(&mesh.points_mm, &[], &cells, &[])
}

/// Encodes a polyline as VTK PolyData; `values` are named arrays with one number per point.
pub fn curve_vtp(points_mm: &[[f64; 3]], values: &[(&str, Vec<f64>)]) -> String {
    let all: Vec<u32> = (0..points_mm.len() as u32).collect();
    poly_data(points_mm, &[&all], &[], values)
}

fn poly_data(
    points_mm: &[[f64; 3]],
    lines: &[&[u32]],
    polygons: &[&[u32]],
    values: &[(&str, Vec<f64>)],
) -> String {
    let mut text = format!(
        "<?xml version=\"1.0\"?>\n<!-- Trabecula, mm, SPACE=LPS -->\n\
         <VTKFile type=\"PolyData\" version=\"0.1\" byte_order=\"LittleEndian\">\n<PolyData>\n\
         <Piece NumberOfPoints=\"{}\" NumberOfVerts=\"0\" NumberOfLines=\"{}\" NumberOfStrips=\"0\" \
         NumberOfPolys=\"{}\">\n",
        points_mm.len(),
        lines.len(),
        polygons.len()
    );
    if let Some((first, _)) = values.first() {
        let _ = writeln!(text, "<PointData Scalars=\"{first}\">");
        for (name, values) in values {
            array(&mut text, &format!("type=\"Float64\" Name=\"{name}\""), values.iter());
        }
        text.push_str("</PointData>\n");
    }
    text.push_str("<Points>\n");
    array(&mut text, "type=\"Float64\" NumberOfComponents=\"3\"", points_mm.iter().flatten());
    text.push_str("</Points>\n");
    for (name, cells) in [("Lines", lines), ("Polys", polygons)] {
        let _ = writeln!(text, "<{name}>");
        array(&mut text, "type=\"Int64\" Name=\"connectivity\"", cells.iter().copied().flatten());
        let ends = cells.iter().scan(0_usize, |end, cell| {
            *end += cell.len();
            Some(*end)
        });
        array(&mut text, "type=\"Int64\" Name=\"offsets\"", ends);
        let _ = writeln!(text, "</{name}>");
    }
    text.push_str("</Piece>\n</PolyData>\n</VTKFile>\n");
    text
}

/// Writes numbers as text that parses back to the same numbers.
fn array(text: &mut String, attributes: &str, numbers: impl Iterator<Item = impl std::fmt::Debug>) {
    let _ = writeln!(text, "<DataArray {attributes} format=\"ascii\">");
    for number in numbers {
        let _ = write!(text, "{number:?} ");
    }
    text.push_str("\n</DataArray>\n");
}
