// Prints what glTF Transform makes of each file named on the command line, a JSON line each.
import { NodeIO, Verbosity } from '@gltf-transform/core';
import { ALL_EXTENSIONS } from '@gltf-transform/extensions';
import draco from 'draco3dgltf';
import { MeshoptDecoder } from 'meshoptimizer';

await MeshoptDecoder.ready;
const dependencies = { 'draco3d.decoder': await draco.createDecoderModule(), 'meshopt.decoder': MeshoptDecoder };

const POINTS_AND_LINES = 4;

// Triangles that a primitive draws.
function triangles(primitive) {
  const corners = (primitive.getIndices() ?? primitive.getAttribute('POSITION')).getCount();
  const mode = primitive.getMode();
  if (mode < POINTS_AND_LINES) return 0;
  return mode === POINTS_AND_LINES ? Math.floor(corners / 3) : Math.max(corners - 2, 0);
}

async function summary(file) {
  const complaints = [];
  const complain = (text) => complaints.push(text);
  const logger = { verbosity: Verbosity.WARN, debug() {}, info() {}, warn: complain, error: complain };
  const io = new NodeIO().setLogger(logger).registerExtensions(ALL_EXTENSIONS).registerDependencies(dependencies);
  const document = await io.read(file);
  const root = document.getRoot();
  const result = { drawn: 0, triangles: 0, morphs: 0, skinned: 0, broken: [] };
  for (const accessor of root.listAccessors()) {
    const array = accessor.getArray();
    if (!array || !array.every(Number.isFinite)) result.broken.push(`accessor ${accessor.getName()} is missing or not finite`);
  }
  for (const primitive of root.listMeshes().flatMap((mesh) => mesh.listPrimitives())) {
    const count = primitive.getAttribute('POSITION').getCount();
    for (const name of primitive.listSemantics()) {
      if (primitive.getAttribute(name).getCount() !== count) result.broken.push(`${name} has another count than POSITION`);
    }
    const indices = primitive.getIndices()?.getArray();
    if (indices?.some((i) => i >= count)) result.broken.push('an index is out of range');
  }
  for (const node of root.listScenes().flatMap((scene) => { const all = []; scene.traverse((n) => all.push(n)); return all; })) {
    for (const primitive of node.getMesh()?.listPrimitives() ?? []) {
      result.drawn += 1;
      result.triangles += triangles(primitive);
      result.morphs += primitive.listTargets().length;
      if (node.getSkin()) result.skinned += 1;
    }
  }
  for (const texture of root.listTextures()) {
    if (!texture.getImage()?.byteLength || !texture.getSize()) result.broken.push(`the texture ${texture.getName()} has no image`);
  }
  const counts = {
    nodes: root.listNodes().length,
    meshes: root.listMeshes().length,
    materials: root.listMaterials().length,
    textures: root.listTextures().length,
    skins: root.listSkins().length,
    joints: root.listSkins().flatMap((skin) => skin.listJoints()).length,
    animations: root.listAnimations().length,
    channels: root.listAnimations().flatMap((animation) => animation.listChannels()).length,
    cameras: root.listCameras().length,
    extensions: root.listExtensionsUsed().map((extension) => extension.extensionName).sort(),
  };
  // What is disposed of must go without dragging anything along.
  root.listAnimations().forEach((animation) => animation.dispose());
  root.listMaterials().forEach((material) => material.dispose());
  if (root.listMeshes().length !== counts.meshes) result.broken.push('meshes went with their materials');
  return { ...result, ...counts, complaints };
}

for (const file of process.argv.slice(2)) {
  const line = await summary(file).catch((error) => ({ broken: [String(error?.message ?? error)] }));
  process.stdout.write(`${JSON.stringify({ file, ...line })}\n`);
}
