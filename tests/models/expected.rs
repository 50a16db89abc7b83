//! Every authored model and every scan, and what `--recipe pack` is to make of it.

/// What becomes of a model.
#[derive(Debug, Clone, Copy)]
pub enum Expected {
    /// It is refined; the warnings beside those that packing gives any model (`kept_input`, `lossy_reencode`).
    Refined(&'static [&'static str]),
    /// It comes back as it was; the warnings that say why.
    Left(&'static [&'static str]),
}

use Expected::{Left, Refined};

/// Authored models.
pub const AUTHORED: [(&str, Expected); 20] = [
    ("pbr/cesium_Balloon_ktx2/CesiumBalloonKTX2Hacky.glb", Refined(&["tiling_too_large"])),
    ("pbr/cesium_Duck_meshopt/Duck-vp-12-vt-12-vn-12.glb", Refined(&[])),
    ("pbr/cesium_MilkTruck_draco/CesiumMilkTruck.gltf", Refined(&["accessor_count_corrected"])),
    ("pbr/draco_Fox/Fox.gltf", Refined(&[])),
    ("pbr/draco_TextureTransformTest/TextureTransformTest.gltf", Refined(&[])),
    ("pbr/gltft_chr_knight/chr_knight.glb", Left(&["nothing_to_refine", "palette_texture"])),
    ("pbr/khr_AnimatedCube/AnimatedCube.gltf", Refined(&[])),
    ("pbr/khr_AnimatedMorphCube/AnimatedMorphCube.glb", Left(&["nothing_to_refine"])),
    ("pbr/khr_Avocado/Avocado.gltf", Refined(&[])),
    ("pbr/khr_BoomBoxWithAxes/BoomBoxWithAxes.gltf", Refined(&[])),
    ("pbr/khr_CesiumMan/CesiumMan.glb", Refined(&[])),
    ("pbr/khr_CesiumMilkTruck/CesiumMilkTruck.glb", Refined(&[])),
    ("pbr/khr_Duck/Duck.glb", Refined(&[])),
    ("pbr/khr_Monster/Monster.glb", Refined(&[])),
    ("pbr/khr_NormalTangentTest/NormalTangentTest.glb", Refined(&[])),
    ("pbr/khr_Suzanne/Suzanne.gltf", Refined(&[])),
    ("pbr/khr_TextureSettingsTest/TextureSettingsTest.glb", Refined(&[])),
    ("pbr/khr_WaterBottle/WaterBottle.gltf", Refined(&[])),
    ("pbr/trimesh_AlphaBlendModeTest/AlphaBlendModeTest.glb", Refined(&[])),
    ("pbr/trimesh_fuze/fuze.obj", Refined(&[])),
];

/// Scans.
pub const SCANS: [(&str, Expected); 10] = [
    ("scans/loaders_agi_ktx2.glb", Refined(&[])),
    ("scans/loaders_tile.glb", Refined(&[])),
    ("scans/meshroom_esp32cam/texturedMesh.obj", Refined(&[])),
    ("scans/planeopt_copyroom/copyroom_c2000_opt.obj", Refined(&[])),
    ("scans/ycb_002_master_chef_can/textured.obj", Refined(&[])),
    ("scans/ycb_025_mug/textured.obj", Refined(&["invalid_normals_replaced"])),
    ("scans/ycb_035_power_drill/textured.obj", Refined(&[])),
    ("scans/ycb_059_chain/textured.obj", Refined(&[])),
    ("scans/ycb_061_foam_brick/textured.obj", Refined(&[])),
    ("scans/ycb_072-a_toy_airplane/textured.obj", Refined(&[])),
];

/// Models made to be difficult.
pub const HOSTILE: [(&str, Expected); 6] = [
    ("hostile/ArtDemo.obj", Left(&["nothing_to_refine"])),
    ("hostile/Corset_missing_images/Corset.gltf", Left(&["missing_image", "nothing_to_refine"])),
    (
        "hostile/MaterialsVariantsShoe_unreadable_images/MaterialsVariantsShoe.gltf",
        Left(&["invalid_image", "nothing_to_refine"]),
    ),
    ("hostile/cube.obj", Left(&["nothing_to_refine"])),
    ("hostile/toy.obj", Left(&["nothing_to_refine"])),
    ("hostile/triangle_clockwise.obj", Left(&["nothing_to_refine"])),
];
