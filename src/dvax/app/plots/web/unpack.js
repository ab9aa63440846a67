// Data inside the page: gzip in base64, and arrays in base64 as Plotly's JSON has them.

async function unpack(id) {
  const text = atob(document.getElementById(id).textContent.trim());
  const bytes = Uint8Array.from(text, (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}

const ARRAYS = {
  f8: Float64Array, f4: Float32Array, i4: Int32Array, u4: Uint32Array, i2: Int16Array,
  u2: Uint16Array, i1: Int8Array, u1: Uint8Array,
};

// Replace each array in base64 by a typed array; one with several axes by nested lists of them.
function decoded(node) {
  if (node === null || typeof node !== "object" || ArrayBuffer.isView(node)) return node;
  if (typeof node.bdata === "string") {
    const bytes = Uint8Array.from(atob(node.bdata), (c) => c.charCodeAt(0));
    const values = new ARRAYS[node.dtype](bytes.buffer);
    return nested(values, node.shape ? String(node.shape).split(",").map(Number) : [values.length]);
  }
  for (const key of Object.keys(node)) node[key] = decoded(node[key]);
  return node;
}

function nested(values, shape) {
  if (shape.length === 1) return values;
  const length = values.length / shape[0];
  return Array.from({ length: shape[0] }, (_, k) =>
    nested(values.subarray(k * length, (k + 1) * length), shape.slice(1)));
}
