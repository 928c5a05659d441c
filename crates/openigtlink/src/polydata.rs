//! POLYDATA: a surface or lines, as VTK's polygonal data.

use crate::Error;
use crate::bytes::{FieldWriter, Fields, u32_of};

pub(crate) const POLYDATA: &str = "POLYDATA";

const POINT_BYTES: usize = 12;

/// Points and the cells that connect them. Each cell lists indices of points.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PolyData {
    /// Points.
    pub points_mm: Vec<[f32; 3]>,
    /// Single points to be drawn.
    pub vertices: Vec<Vec<u32>>,
    /// Polylines.
    pub lines: Vec<Vec<u32>>,
    /// Polygons.
    pub polygons: Vec<Vec<u32>>,
    /// Triangle strips.
    pub triangle_strips: Vec<Vec<u32>>,
}

impl PolyData {
    fn cells(&self) -> [&Vec<Vec<u32>>; 4] {
        [&self.vertices, &self.lines, &self.polygons, &self.triangle_strips]
    }
}

/// Returns the size of a group of cells in bytes: each has its number of points and their indices.
fn cell_bytes(cells: &[Vec<u32>]) -> usize {
    cells.iter().map(|cell| 4 * (1 + cell.len())).sum()
}

pub(crate) fn write(data: &PolyData, body: &mut Vec<u8>) -> Result<(), Error> {
    check_indices(data)?;
    body.put_u32(u32_of(POLYDATA, "number of points", data.points_mm.len())?);
    for cells in data.cells() {
        body.put_u32(u32_of(POLYDATA, "number of cells", cells.len())?);
        body.put_u32(u32_of(POLYDATA, "bytes of cells", cell_bytes(cells))?);
    }
    // No attributes.
    body.put_u32(0);
    data.points_mm.iter().for_each(|point| body.put_f32s(point));
    for cell in data.cells().into_iter().flatten() {
        body.put_u32(u32_of(POLYDATA, "points of a cell", cell.len())?);
        cell.iter().for_each(|index| body.put_u32(*index));
    }
    Ok(())
}

/// Reads a body. Attributes (colours, normals) are skipped.
pub(crate) fn read(body: &[u8]) -> Result<PolyData, Error> {
    let mut fields = Fields::new(POLYDATA, body);
    let point_count = fields.u32()? as usize;
    let mut groups = [(0, 0); 4];
    for group in &mut groups {
        *group = (fields.u32()? as usize, fields.u32()? as usize);
    }
    let _attributes = fields.u32()?;
    let mut points = Fields::new(POLYDATA, fields.take(point_count.saturating_mul(POINT_BYTES))?);
    let points_mm = (0..point_count).map(|_| points.vector("point")).collect::<Result<_, _>>()?;
    let mut read_group = |(count, bytes): (usize, usize)| cells(count, fields.take(bytes)?);
    let [vertices, lines, polygons, strips] = groups;
    let data = PolyData {
        points_mm,
        vertices: read_group(vertices)?,
        lines: read_group(lines)?,
        polygons: read_group(polygons)?,
        triangle_strips: read_group(strips)?,
    };
    check_indices(&data)?;
    Ok(data)
}

fn cells(count: usize, bytes: &[u8]) -> Result<Vec<Vec<u32>>, Error> {
    let mut fields = Fields::new(POLYDATA, bytes);
    // A cell has at least the four bytes of its length.
    let mut cells = Vec::with_capacity(count.min(bytes.len() / 4));
    for _ in 0..count {
        let length = fields.u32()? as usize;
        let (indices, _) = fields.take(length.saturating_mul(4))?.as_chunks::<4>();
        cells.push(indices.iter().map(|index| u32::from_be_bytes(*index)).collect());
    }
    fields.end()?;
    Ok(cells)
}

fn check_indices(data: &PolyData) -> Result<(), Error> {
    let points = data.points_mm.len();
    let wrong = |index: &&u32| usize::try_from(**index).map_or(true, |index| index >= points);
    let Some(index) = data.cells().into_iter().flatten().flatten().find(wrong) else { return Ok(()) };
    let expected = "below the number of points";
    Err(Error::Field { kind: POLYDATA, field: "index of a point", given: index.to_string(), expected })
}
