//! Draws the tool over the anatomy, row by row, visiting only pixels inside the projected outlines of its
//! parts.

use pulp::Arch;
use rayon::prelude::*;
use smallvec::SmallVec;

use crate::attenuation::Material;
use crate::buckets::sort_into_buckets;
use crate::carm::{CArm, Pinhole};
use crate::displaced::displaced_integral;
use crate::error::DrrError;
use crate::ray::{IndexRay, Pixel, RayFan, WorldRay};
use crate::removal::AttenuationField;
use crate::renderer::Projector;
use crate::siddon;
use crate::tool::{PreparedPart, SeenPart, Tool, join_intervals};
use crate::tool_row::{Crossings, RowOfRays};

/// Margin of an outline against rounding in the projection, in pixels.
const SLACK: f64 = 1e-3;
/// Up to this number of parts over one pixel, nothing is allocated.
const AT_ONCE: usize = 16;

/// A part seen from the frame's source, and its attenuation at the frame's energy.
#[derive(Debug)]
struct PlacedPart {
    part: SeenPart,
    mu_per_m: f64,
    material: usize,
}

/// The effect of the tool on one pixel.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct ToolCell {
    /// Line integral of the displaced anatomy; metres of tissue if a spectrum is used.
    pub(crate) displaced: f64,
    /// Line integral of the metal at the frame's energy.
    pub(crate) metal: f64,
}

/// Additional data for the same pixel if a spectrum is used.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct ToolMaterials {
    /// Metres of displaced cortical bone.
    pub(crate) displaced_bone_m: f64,
    /// Metres of each material, by [`Material::index`].
    pub(crate) lengths_m: [f64; Material::COUNT],
}

impl ToolCell {
    /// True if the tool covers the pixel.
    fn is_covered(&self) -> bool {
        self.metal > 0.0 || self.displaced > 0.0
    }

    /// The anatomy's line integral with the tool inserted.
    pub(crate) fn over(&self, anatomy: f64) -> f64 {
        // Fully displaced anatomy can leave a slightly negative rest from rounding.
        (anatomy - self.displaced).max(0.0) + self.metal
    }
}

/// Columns `first..end` of a row in which a part can cover pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
struct Span {
    row: u32,
    first: u32,
    part: u32,
    end: u32,
}

/// The tool's parts in a C-arm's view, by image row. Reused from frame to frame, so that placing allocates
/// nothing.
#[derive(Debug, Default)]
pub(crate) struct PlacedTool {
    parts: Vec<PlacedPart>,
    /// By row, then by first column.
    spans: Vec<Span>,
    /// Spans of row `first_row + i` are `row_starts[i]..row_starts[i + 1]`.
    row_starts: Vec<usize>,
    first_row: u32,
    unsorted: Vec<Span>,
    outline: Outline,
    /// Columns of each row's cells: those from the first to the last span.
    segments: Vec<(u32, u32)>,
    /// The cells of row `first_row + i` start at `i * stride`.
    cells: Vec<ToolCell>,
    /// Like `cells`; empty without a spectrum.
    materials: Vec<ToolMaterials>,
    stride: usize,
}

impl PlacedTool {
    /// Finds the parts of the tool that are in the C-arm's field of view.
    pub(crate) fn place(&mut self, tool: &Tool, c_arm: &CArm, energy_kev: f64) -> Result<(), DrrError> {
        self.parts.clear();
        self.unsorted.clear();
        let pinhole = c_arm.pinhole();
        for prepared in tool.prepared() {
            let prepared = prepared?;
            let mu_per_m = prepared.material().mu_per_m(energy_kev)?;
            let before = self.unsorted.len();
            self.outline.draw(&prepared, c_arm, &pinhole, self.parts.len() as u32, &mut self.unsorted);
            if self.unsorted.len() > before {
                let (part, material) = (prepared.seen_from(c_arm.source_m), prepared.material().index());
                self.parts.push(PlacedPart { part, mu_per_m, material });
            }
        }
        self.sort_spans();
        Ok(())
    }

    /// Sorts by row, then by column.
    fn sort_spans(&mut self) {
        let first = self.unsorted.iter().map(|s| s.row).min().unwrap_or(0);
        let end = self.unsorted.iter().map(|s| s.row + 1).max().unwrap_or(0);
        self.first_row = first;
        let spans = self.unsorted.iter().map(|span| ((span.row - first) as usize, *span));
        sort_into_buckets(spans, (end - first) as usize, &mut self.row_starts, &mut self.spans);
        for row in self.row_starts.windows(2) {
            self.spans[row[0]..row[1]].sort_unstable();
        }
    }

    /// Computes the cells; returns the number of pixels that the tool covers. `anatomy` provides what is
    /// displaced.
    pub(crate) fn draw(&mut self, fan: &RayFan, anatomy: &DisplacedAnatomy<'_>) -> usize {
        self.segments.clear();
        for row in self.row_starts.windows(2) {
            let spans = &self.spans[row[0]..row[1]];
            let first = spans.first().map_or(0, |s| s.first);
            let end = spans.iter().map(|s| s.end).max().unwrap_or(0);
            self.segments.push((first, end));
        }
        self.stride =
            self.segments.iter().map(|(first, end)| (end - first) as usize).max().unwrap_or(0).max(1);
        let size = self.stride * self.segments.len();
        self.cells.resize(size, ToolCell::default());
        self.materials.resize(if anatomy.bone.is_some() { size } else { 0 }, ToolMaterials::default());
        let mut cells = core::mem::take(&mut self.cells);
        let mut materials = core::mem::take(&mut self.materials);
        let painter = Painter { tool: self, fan, anatomy, arch: Arch::new() };
        let (first, end) = (self.first_row, self.first_row + self.segments.len() as u32);
        let rows = cells.par_chunks_mut(self.stride).zip(first..end);
        let covered = if materials.is_empty() {
            rows.map_init(RowWork::default, |work, (cells, row)| painter.draw_row(work, row, cells, &mut []))
                .sum()
        } else {
            rows.zip(materials.par_chunks_mut(self.stride))
                .map_init(RowWork::default, |work, ((cells, row), materials)| {
                    painter.draw_row(work, row, cells, materials)
                })
                .sum()
        };
        (self.cells, self.materials) = (cells, materials);
        covered
    }

    /// Calls `f(i, cell, materials)` for the covered pixels `from + i`, i below `count`, of an image row.
    #[inline]
    pub(crate) fn over_row(
        &self,
        row: usize,
        from: usize,
        count: usize,
        mut f: impl FnMut(usize, &ToolCell, Option<&ToolMaterials>),
    ) {
        let Some(line) = row.checked_sub(self.first_row as usize) else { return };
        let Some(&(first, end)) = self.segments.get(line) else { return };
        let (first, end) = (first as usize, end as usize);
        for column in first.max(from)..end.min(from + count) {
            let at = line * self.stride + column - first;
            if self.cells[at].is_covered() {
                f(column - from, &self.cells[at], self.materials.get(at));
            }
        }
    }

    fn spans_of(&self, row: u32) -> &[Span] {
        let i = (row - self.first_row) as usize;
        &self.spans[self.row_starts[i]..self.row_starts[i + 1]]
    }
}

/// Converts a part's projected box to spans.
#[derive(Debug, Default)]
struct Outline {
    /// Lowest and highest column of the box per image row; [`NOWHERE`] in all rows between parts.
    rows: Vec<(f64, f64)>,
}

/// Columns of a row that no edge crosses.
const NOWHERE: (f64, f64) = (f64::INFINITY, f64::NEG_INFINITY);

impl Outline {
    /// Appends the part's spans.
    fn draw(
        &mut self,
        part: &PreparedPart,
        c_arm: &CArm,
        pinhole: &Pinhole,
        number: u32,
        out: &mut Vec<Span>,
    ) {
        let (centre, half) = part.box_from(c_arm.source_m);
        let corners = pinhole.corners(centre, &half);
        if corners.iter().all(Option::is_none) {
            return;
        }
        if !corners.iter().all(Option::is_some) {
            // Around or level with the source: it can cover any pixel.
            let whole = |row| Span { row, first: 0, part: number, end: c_arm.columns };
            out.extend((0..c_arm.rows).map(whole));
            return;
        }
        let corner = |i: usize| corners[i].map_or((0.0, 0.0), |p| (p.column, p.row));
        self.rows.resize(c_arm.rows as usize, NOWHERE);
        let (mut first, mut end) = (c_arm.rows, 0);
        // The outline of a convex body's projection consists of projected edges.
        for i in 0..8_usize {
            for axis in [1, 2, 4] {
                if i & axis == 0 {
                    let touched = self.add_edge(corner(i), corner(i | axis));
                    (first, end) = (first.min(touched.0), end.max(touched.1));
                }
            }
        }
        for row in first..end {
            let (low, high) = core::mem::replace(&mut self.rows[row as usize], NOWHERE);
            // `as` saturates, so anything far outside gives an empty range.
            let from = libm::ceil(low - SLACK).max(0.0) as u32;
            let to = (libm::floor(high + SLACK) + 1.0).clamp(0.0, f64::from(c_arm.columns)) as u32;
            if from < to {
                out.push(Span { row, first: from, part: number, end: to });
            }
        }
    }

    /// Extends the rows that an edge between two image points (column, row) crosses; returns their range.
    fn add_edge(&mut self, p: (f64, f64), q: (f64, f64)) -> (u32, u32) {
        let (a, b) = if p.1 <= q.1 { (p, q) } else { (q, p) };
        let first = libm::ceil(a.1 - SLACK).max(0.0) as u32;
        let end = (libm::floor(b.1 + SLACK) + 1.0).clamp(0.0, self.rows.len() as f64) as u32;
        let flat = b.1 - a.1 < SLACK;
        let slope = if flat { 0.0 } else { (b.0 - a.0) / (b.1 - a.1) };
        for row in first..end {
            let at = (f64::from(row).clamp(a.1, b.1) - a.1) * slope + a.0;
            let (low, high) = if flat { (a.0.min(b.0), a.0.max(b.0)) } else { (at, at) };
            let limits = &mut self.rows[row as usize];
            *limits = (limits.0.min(low), limits.1.max(high));
        }
        (first, end)
    }
}

/// The anatomy that the tool displaces.
pub(crate) struct DisplacedAnatomy<'a> {
    pub(crate) projector: Projector,
    /// Integrand of `ToolCell::displaced`.
    pub(crate) tissue: &'a AttenuationField<'a>,
    /// Integrand of `ToolMaterials::displaced_bone_m`, with a spectrum.
    pub(crate) bone: Option<&'a AttenuationField<'a>>,
}

impl DisplacedAnatomy<'_> {
    /// Integral of a field between two parameters of a ray.
    fn integral(&self, field: &AttenuationField<'_>, ray: &IndexRay, range: (f64, f64)) -> f64 {
        if self.projector == Projector::Siddon {
            siddon::line_integral(field, ray, range)
        } else {
            // Sums over slices use the same samples as Joseph's method.
            displaced_integral(field, ray, range)
        }
    }
}

/// Inputs of drawing the tool.
struct Painter<'a> {
    tool: &'a PlacedTool,
    fan: &'a RayFan,
    anatomy: &'a DisplacedAnatomy<'a>,
    arch: Arch,
}

/// Workspace of a row.
#[derive(Debug, Default)]
struct RowWork {
    rays: RowOfRays,
    crossings: Crossings,
    /// Start of each span's crossings.
    starts: Vec<usize>,
}

/// A span that covers the column.
#[derive(Debug, Clone, Copy)]
struct Active {
    span: Span,
    /// Start of its crossings.
    start: usize,
}

impl Painter<'_> {
    /// Fills the cells of a row; returns how many are covered.
    fn draw_row(
        &self,
        work: &mut RowWork,
        row: u32,
        cells: &mut [ToolCell],
        materials: &mut [ToolMaterials],
    ) -> usize {
        let spans = self.tool.spans_of(row);
        let (first, end) = self.tool.segments[(row - self.tool.first_row) as usize];
        let count = (end - first) as usize;
        cells[..count].fill(ToolCell::default());
        materials.iter_mut().take(count).for_each(|m| *m = ToolMaterials::default());
        work.rays.aim(self.arch, self.fan, Pixel { column: first, row }, count);
        work.crossings.clear();
        work.starts.clear();
        for span in spans {
            let range = (span.first - first) as usize..(span.end - first) as usize;
            let part = &self.tool.parts[span.part as usize].part;
            work.starts.push(work.crossings.append(self.arch, part, &work.rays, range));
        }
        let mut waiting = spans.iter().zip(&work.starts).peekable();
        let mut active: SmallVec<[Active; AT_ONCE]> = SmallVec::new();
        let mut envelopes: SmallVec<[(f64, f64); AT_ONCE]> = SmallVec::new();
        let mut covered = 0;
        let mut column = 0;
        loop {
            active.retain(|active| active.span.end > column);
            if active.is_empty() {
                let Some((next, _)) = waiting.peek() else { break };
                column = column.max(next.first);
            }
            while let Some((span, start)) = waiting.next_if(|(span, _)| span.first <= column) {
                // In the tool's order, which determines the order of the sums.
                let at = active.partition_point(|other| other.span.part < span.part);
                active.insert(at, Active { span: *span, start: *start });
            }
            let at = (column - first) as usize;
            let materials = materials.get_mut(at);
            let ray = work.rays.at(self.fan, at);
            let cell = self.draw_pixel(
                Pixel { column, row },
                &ray,
                &work.crossings,
                &active,
                &mut envelopes,
                materials,
            );
            covered += usize::from(cell.is_covered());
            cells[at] = cell;
            column += 1;
        }
        covered
    }

    #[inline]
    fn draw_pixel(
        &self,
        pixel: Pixel,
        ray: &WorldRay,
        crossings: &Crossings,
        active: &[Active],
        envelopes: &mut SmallVec<[(f64, f64); AT_ONCE]>,
        mut materials: Option<&mut ToolMaterials>,
    ) -> ToolCell {
        let Pixel { column, row } = pixel;
        envelopes.clear();
        let mut cell = ToolCell::default();
        for Active { span, start } in active {
            if let Some(crossing) = crossings.at(start + (column - span.first) as usize) {
                let placed = &self.tool.parts[span.part as usize];
                envelopes.push(crossing.envelope);
                cell.metal += placed.mu_per_m * crossing.metal_m;
                if let Some(materials) = materials.as_deref_mut() {
                    materials.lengths_m[placed.material] += crossing.metal_m;
                }
            }
        }
        if envelopes.is_empty() {
            return cell;
        }
        let joined = join_intervals(envelopes);
        let index_ray = self.fan.index_ray_of(column, row, ray);
        for &range in &envelopes[..joined] {
            cell.displaced += self.anatomy.integral(self.anatomy.tissue, &index_ray, range);
            if let (Some(materials), Some(bone)) = (materials.as_deref_mut(), self.anatomy.bone) {
                materials.displaced_bone_m += self.anatomy.integral(bone, &index_ray, range);
            }
        }
        cell
    }
}
