//! What the surface is made of, read with the `gltf` crate, which is not what Intarsia reads with.

/// Everything but TEXCOORD and TANGENT of one corner of one triangle.
#[derive(Debug, Clone, PartialEq)]
pub struct Corner {
    position: [f32; 3],
    normal: Option<[f32; 3]>,
    joints: Option<[u16; 4]>,
    weights: Option<[f32; 4]>,
    /// By morph target, the displacement.
    morphs: Vec<[f32; 3]>,
}

/// The corners of every triangle of every primitive, in order: by mesh, by primitive. The crate reads no positions but
/// floats: a primitive with others has none here.
pub fn corners(glb: &[u8]) -> Vec<Vec<Corner>> {
    let model = gltf::Gltf::from_slice_without_validation(glb).expect("a GLB");
    let blob = model.blob.as_deref().unwrap_or_default();
    let mut all = Vec::new();
    for primitive in model.meshes().flat_map(|m| m.primitives().collect::<Vec<_>>()) {
        let positions = primitive.get(&gltf::Semantic::Positions).expect("positions");
        if positions.data_type() != gltf::accessor::DataType::F32 {
            all.push(Vec::new());
            continue;
        }
        let reader = primitive.reader(|_| Some(blob));
        let positions: Vec<_> = reader.read_positions().expect("positions").collect();
        let normals: Option<Vec<_>> = reader.read_normals().map(Iterator::collect);
        let joints: Option<Vec<_>> = reader.read_joints(0).map(|j| j.into_u16().collect());
        let weights: Option<Vec<_>> = reader.read_weights(0).map(|w| w.into_f32().collect());
        let morphs: Vec<Vec<_>> = reader.read_morph_targets().filter_map(|(p, ..)| Some(p?.collect())).collect();
        let indices: Vec<u32> = match reader.read_indices() {
            Some(indices) => indices.into_u32().collect(),
            None => (0..positions.len() as u32).collect(),
        };
        let corner = |i: u32| {
            let i = i as usize;
            Corner {
                position: positions[i],
                normal: normals.as_ref().map(|n| n[i]),
                joints: joints.as_ref().map(|j| j[i]),
                weights: weights.as_ref().map(|w| w[i]),
                morphs: morphs.iter().map(|m| m[i]).collect(),
            }
        };
        let triangles: Vec<u32> = match primitive.mode() {
            gltf::mesh::Mode::TriangleStrip => {
                let turned = |(i, w): (usize, &[u32])| [w[0], w[1 + i % 2], w[2 - i % 2]];
                indices.windows(3).enumerate().flat_map(turned).collect()
            }
            gltf::mesh::Mode::TriangleFan => indices[1..].windows(2).flat_map(|w| [w[0], w[1], indices[0]]).collect(),
            _ => indices,
        };
        all.push(triangles.into_iter().map(corner).collect());
    }
    all
}
