// Prints what the Khronos validator has to say of each file, as JSON.
const fs = require("fs");
const [modules, ...files] = process.argv.slice(2);
const { validateBytes } = require(modules + "/gltf-validator");
Promise.all(files.map((file) => validateBytes(new Uint8Array(fs.readFileSync(file))))).then(
  (reports) => console.log(JSON.stringify(reports.map(({ issues, info }) => ({ issues, info }))))
);
