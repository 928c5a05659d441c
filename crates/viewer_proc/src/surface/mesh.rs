//! A block's mesh as sent to the page.

const MAGIC: u32 = 0x4853_4D54; // "TMSH"
const VERSION: u32 = 1;

/// Triangles of one block, in the patient frame.
#[derive(Debug, Clone, PartialEq)]
pub struct BlockMesh {
    /// Block number.
    pub block: u32,
    /// Lowest corner, in steps of `scale_m`.
    pub origin: [i64; 3],
    /// Length of a step, m.
    pub scale_m: f64,
    /// Vertices in steps from the lowest corner.
    pub positions: Vec<[u16; 3]>,
    /// Outward normals in 127ths.
    pub normals: Vec<[i8; 3]>,
    /// Three vertices per triangle, counterclockwise seen from outside.
    pub indices: Vec<u32>,
}

impl BlockMesh {
    /// A block without a surface.
    pub fn empty(block: u32) -> BlockMesh {
        let (positions, normals, indices) = (Vec::new(), Vec::new(), Vec::new());
        BlockMesh { block, origin: [0; 3], scale_m: 1.0, positions, normals, indices }
    }

    /// Creates a mesh from vertices in steps from the patient frame's origin, spanning less than 65536 steps.
    pub fn new(
        block: u32,
        scale_m: f64,
        vertices: &[[i64; 3]],
        normals: Vec<[i8; 3]>,
        indices: Vec<u32>,
    ) -> BlockMesh {
        let least = |axis: usize| vertices.iter().map(|vertex| vertex[axis]).min().unwrap_or(0);
        let origin = [least(0), least(1), least(2)];
        let position = |vertex: &[i64; 3]| core::array::from_fn(|axis| (vertex[axis] - origin[axis]) as u16);
        BlockMesh {
            block,
            origin,
            scale_m,
            positions: vertices.iter().map(position).collect(),
            normals,
            indices,
        }
    }

    /// Returns a vertex in steps from the patient frame's origin; identical in all blocks that share it.
    pub fn steps(&self, vertex: u32) -> [i64; 3] {
        let position = self.positions[vertex as usize];
        core::array::from_fn(|axis| self.origin[axis] + i64::from(position[axis]))
    }

    /// Returns a vertex in the patient frame, m.
    pub fn vertex_m(&self, vertex: u32) -> [f64; 3] {
        self.steps(vertex).map(|steps| steps as f64 * self.scale_m)
    }

    /// Returns the wire format, little-endian: magic, version, block, number of vertices and of indices
    /// (u32), origin (3 f32, m), scale (f32, m), positions (3 u16), padding to 4 bytes, normals (x, y, z, 0
    /// as i8), indices (u32).
    pub fn bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(40 + self.positions.len() * 10 + self.indices.len() * 4);
        let counts = [self.positions.len() as u32, self.indices.len() as u32];
        for word in [MAGIC, VERSION, self.block, counts[0], counts[1]] {
            bytes.extend_from_slice(&word.to_le_bytes());
        }
        let origin_m = self.origin.map(|steps| steps as f64 * self.scale_m);
        for metres in origin_m.into_iter().chain([self.scale_m]) {
            bytes.extend_from_slice(&(metres as f32).to_le_bytes());
        }
        self.positions.iter().flatten().for_each(|x| bytes.extend_from_slice(&x.to_le_bytes()));
        bytes.resize(bytes.len().next_multiple_of(4), 0);
        for [x, y, z] in &self.normals {
            bytes.extend([x, y, z].map(|part| *part as u8));
            bytes.push(0);
        }
        self.indices.iter().for_each(|index| bytes.extend_from_slice(&index.to_le_bytes()));
        bytes
    }
}
