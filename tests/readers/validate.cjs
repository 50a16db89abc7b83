// Prints the Khronos validator's report of each file named on the command line, a JSON line each.
const fs = require('fs');
const path = require('path');
const validator = require('gltf-validator');

(async () => {
  for (const file of process.argv.slice(2)) {
    const folder = path.dirname(file);
    const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {
      uri: path.basename(file),
      maxIssues: 0,
      externalResourceFunction: (uri) =>
        new Promise((resolve, reject) => {
          fs.readFile(path.join(folder, decodeURIComponent(uri)), (error, bytes) => (error ? reject(error.toString()) : resolve(new Uint8Array(bytes))));
        }),
    }).catch((error) => ({ issues: { messages: [{ severity: 0, code: 'VALIDATOR', message: String(error) }] } }));
    const errors = report.issues.messages.filter((m) => m.severity === 0).map(({ code, message, pointer }) => ({ code, message, pointer }));
    console.log(JSON.stringify({ file, errors }));
  }
})();
