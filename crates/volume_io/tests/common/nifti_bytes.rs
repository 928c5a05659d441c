//! Small NIfTI-1 files built byte by byte from nifti1.h.

/// A NIfTI-1 file of int16 voxels with an sform; every field can be overwritten before it is written.
pub struct NiftiBytes(pub Vec<u8>);

impl NiftiBytes {
    pub fn new(dims: [i16; 3], affine_mm: [[f32; 4]; 3], voxels: &[i16]) -> Self {
        let mut file = Self(vec![0; 352]);
        file.put(0, &348_i32.to_le_bytes());
        for (i, n) in [3, dims[0], dims[1], dims[2], 1, 1, 1, 1].into_iter().enumerate() {
            file.put(40 + 2 * i, &n.to_le_bytes());
        }
        file.put(70, &4_i16.to_le_bytes());
        file.put(72, &16_i16.to_le_bytes());
        for i in 0..8 {
            file.put(76 + 4 * i, &1.0_f32.to_le_bytes());
        }
        file.put(108, &352.0_f32.to_le_bytes());
        file.put(123, &[2]);
        file.put(254, &1_i16.to_le_bytes());
        for (i, value) in affine_mm.iter().flatten().enumerate() {
            file.put(280 + 4 * i, &value.to_le_bytes());
        }
        file.put(344, b"n+1\0");
        for voxel in voxels {
            file.0.extend(voxel.to_le_bytes());
        }
        file
    }

    pub fn put(&mut self, at: usize, bytes: &[u8]) {
        self.0[at..at + bytes.len()].copy_from_slice(bytes);
    }
}
