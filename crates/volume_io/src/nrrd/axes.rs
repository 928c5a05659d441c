//! Determines the spatial axes of an NRRD file.

use super::header::Header;
use crate::error::{Field, VolumeError};
use crate::text_header::{all_sizes, wrong};
use crate::volume::voxel_count;
use std::path::Path;

/// The spatial axes, and at most one other.
pub(super) struct Axes {
    /// Sizes of the spatial axes.
    pub dims: [usize; 3],
    /// Positions of the spatial axes among all axes.
    pub spatial: [usize; 3],
    /// The fourth axis, of times or layers.
    pub other: Option<OtherAxis>,
}

/// An axis that is not spatial.
#[derive(Clone, Copy)]
pub(super) struct OtherAxis {
    pub size: usize,
    /// Distance between neighbours along it, in voxels.
    stride: usize,
}

impl OtherAxis {
    /// The voxels at one position along the axis.
    pub fn part(self, numbers: &[i16], at: usize) -> Vec<i16> {
        let block = self.stride * self.size;
        let start = at * self.stride;
        numbers.chunks(block).flat_map(|block| block[start..start + self.stride].iter().copied()).collect()
    }
}

impl Axes {
    /// Determines the axes; the error says what the file has instead.
    pub fn of(header: &Header<'_>) -> Result<Self, VolumeError> {
        let path = header.path;
        let rank = header.require("dimension", "3")?;
        let given_sizes = header.require("sizes", "three positive whole numbers")?;
        let Ok(axis_count) = rank.parse::<u8>() else { return Err(wrong(path, "dimension", rank, "3")) };
        let not_three = || {
            VolumeError::NotThreeDimensional(Field::new(
                path,
                "dimension",
                format!("{rank} with sizes {given_sizes}"),
            ))
        };
        let kinds: Vec<String> =
            header.get("kinds").unwrap_or("").split_whitespace().map(str::to_lowercase).collect();
        let list_allowed = axis_count == 4;
        let scalar = |kind: &String| {
            matches!(kind.as_str(), "domain" | "space" | "time" | "none" | "???")
                || (list_allowed && kind == "list")
        };
        if let Some(kind) = kinds.iter().find(|kind| !scalar(kind)) {
            return Err(VolumeError::NotScalar(Field::new(
                path,
                "kinds",
                format!("`{kind}` in `{}`", header.get("kinds").unwrap_or("")),
            )));
        }
        if axis_count != 3 && axis_count != 4 {
            return Err(not_three());
        }
        let sizes = all_sizes(path, "sizes", given_sizes, usize::from(axis_count))?;
        let [i, j, k] = match sizes.as_slice() {
            [i, j, k] => [*i, *j, *k],
            _ => return Self::of_four(header, &sizes, &kinds).ok_or_else(not_three),
        };
        Ok(Self { dims: [i, j, k], spatial: [0, 1, 2], other: None })
    }

    /// Three spatial axes and one other, identified by `space directions`, by `kinds` or by a size of 1;
    /// `None` if by none of them.
    fn of_four(header: &Header<'_>, sizes: &[usize], kinds: &[String]) -> Option<Self> {
        let directions = super::geometry::split_vectors(header.get("space directions").unwrap_or(""));
        let only = |is: &dyn Fn(usize) -> bool| {
            let mut found = (0..4).filter(|axis| is(*axis));
            found.next().filter(|_| found.next().is_none())
        };
        let other = only(&|axis| directions.get(axis).is_some_and(|vector| vector == "none"))
            .or_else(|| only(&|axis| kinds.get(axis).is_some_and(|kind| kind == "list" || kind == "time")))
            .or_else(|| (sizes[3] == 1).then_some(3))
            .or_else(|| (sizes[0] == 1).then_some(0))?;
        let is_layers = kinds.get(other).is_some_and(|kind| kind == "list");
        if sizes[other] != 1 && !(is_layers && super::segments::are_in(header)) {
            return None;
        }
        let mut spatial = [0; 3];
        for (slot, axis) in spatial.iter_mut().zip((0..4).filter(|axis| *axis != other)) {
            *slot = axis;
        }
        let stride = sizes[..other].iter().product();
        Some(Self {
            dims: spatial.map(|axis| sizes[axis]),
            spatial,
            other: Some(OtherAxis { size: sizes[other], stride }),
        })
    }

    /// How many numbers the file holds, if that many are read.
    pub fn number_count(&self, path: &Path) -> Result<usize, VolumeError> {
        let voxels = voxel_count(path, "sizes", self.dims)?;
        let layers = self.other.map_or(1, |other| other.size);
        let all = voxels.checked_mul(layers).filter(|all| *all <= voxel_grid::MAX_VOXELS);
        all.ok_or_else(|| {
            VolumeError::TooLarge(Field::new(path, "sizes", format!("{layers} layers of {voxels} voxels")))
        })
    }

    /// The entries of a field for the spatial axes, from one entry per axis; a field of three entries is for
    /// the spatial axes only.
    pub fn pick<T: Clone>(&self, entries: &[T]) -> Option<[T; 3]> {
        if entries.len() == 3 {
            return <[T; 3]>::try_from(entries.to_vec()).ok();
        }
        let [i, j, k] = self.spatial;
        Some([entries.get(i)?.clone(), entries.get(j)?.clone(), entries.get(k)?.clone()])
    }
}
