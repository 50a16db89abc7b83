// Binomial's own transcoder, as three.js ships it: what a KTX2 file with blocks of Basis Universal shows.
import crypto from 'node:crypto';
import fs from 'node:fs';
import { createRequire } from 'node:module';
import path from 'node:path';
import { fileURLToPath } from 'node:url';

const library = (name) => fileURLToPath(import.meta.resolve(`three/addons/libs/basis/${name}`));

let module;

async function transcoder() {
  if (!module) {
    // It was made for CommonJS.
    const file = library('basis_transcoder.js');
    const names = ['module', 'exports', 'require', '__filename', '__dirname'];
    const run = new Function(...names, `${fs.readFileSync(file, 'utf8')}; return BASIS;`);
    const factory = run({ exports: {} }, {}, createRequire(import.meta.url), file, path.dirname(file));
    module = await new Promise((resolve, reject) => {
      factory({ wasmBinary: fs.readFileSync(library('basis_transcoder.wasm')) }).then(resolve, reject);
    });
    module.initializeBasis();
  }
  return module;
}

const RGBA32 = 13;
// BC7, ASTC, ETC2: what graphics cards read.
const OTHERS = [6, 10, 1];

/** What a file shows: its size, levels, and a hash of the first level as RGBA. Throws where it cannot be read. */
export async function read(bytes) {
  const { KTX2File } = await transcoder();
  const file = new KTX2File(new Uint8Array(bytes));
  try {
    if (!file.isValid()) throw new Error('the KTX2 file is not valid');
    if (!file.startTranscoding()) throw new Error('the KTX2 file cannot be transcoded');
    const levels = file.getLevels();
    let hash;
    for (let level = 0; level < levels; level += 1) {
      for (const format of [RGBA32, ...OTHERS]) {
        const out = new Uint8Array(file.getImageTranscodedSizeInBytes(level, 0, 0, format));
        if (!file.transcodeImage(out, level, 0, 0, format, 0, -1, -1)) throw new Error(`level ${level} cannot be transcoded to format ${format}`);
        if (level === 0 && format === RGBA32) hash = crypto.createHash('sha256').update(out).digest('hex');
      }
    }
    return { width: file.getWidth(), height: file.getHeight(), levels, alpha: Boolean(file.getHasAlpha()), uastc: Boolean(file.isUASTC()), sha256: hash };
  } finally {
    file.close();
    file.delete();
  }
}

if (process.argv[1] === fileURLToPath(import.meta.url)) {
  for (const file of process.argv.slice(2)) {
    const line = await read(fs.readFileSync(file)).catch((error) => ({ broken: String(error?.message ?? error) }));
    process.stdout.write(`${JSON.stringify({ file, ...line })}\n`);
  }
}
