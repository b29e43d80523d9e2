// The bowl: a mesh sent once, a texture per camera, drawn as often as the browser likes. Drag turns, wheel zooms.
"use strict";
class Bowl {
  constructor(canvas) {
    this.canvas = canvas;
    this.azimuth = Math.PI; this.elevation = 0.6; this.distance = 16;
    this.draws = 0; this.cameras = []; this.tilt = [1, 0, 0, 0, 1, 0, 0, 0, 1];
    const gl = this.gl = canvas.getContext("webgl", { alpha: false, preserveDrawingBuffer: true });
    if (!gl) return;
    const program = this.program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, Bowl.VERTEX], [gl.FRAGMENT_SHADER, Bowl.FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source); gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program); gl.useProgram(program);
    this.at = {}; for (const name of ["place", "source"]) this.at[name] = gl.getAttribLocation(program, name);
    for (const name of ["screen_from_level", "gain", "picture"]) this.at[name] = gl.getUniformLocation(program, name);
    this.listen();
    const frame = () => { if (!canvas.hidden && this.count) this.draw(); requestAnimationFrame(frame); };
    requestAnimationFrame(frame);
  }

  listen() {
    let held = null;
    this.canvas.addEventListener("pointerdown", (e) => { held = [e.clientX, e.clientY]; this.canvas.setPointerCapture(e.pointerId); });
    this.canvas.addEventListener("pointerup", () => { held = null; });
    this.canvas.addEventListener("pointermove", (e) => {
      if (!held) return;
      this.azimuth += (e.clientX - held[0]) * 0.006;
      this.elevation = Math.min(1.5, Math.max(0.08, this.elevation + (e.clientY - held[1]) * 0.006));
      held = [e.clientX, e.clientY];
    });
    this.canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.distance = Math.min(40, Math.max(4, this.distance * Math.exp(e.deltaY * 0.001)));
    }, { passive: false });
  }

  setMesh(header, content) {
    const gl = this.gl;
    if (!gl) throw new Error("This browser has no WebGL: the bowl cannot be drawn.");
    const { rows, columns } = header, vertices = rows * columns;
    const values = new Float32Array(content);
    const buffer = (target, data) => {
      const made = gl.createBuffer(); gl.bindBuffer(target, made); gl.bufferData(target, data, gl.STATIC_DRAW); return made;
    };
    this.places = buffer(gl.ARRAY_BUFFER, values.subarray(0, 3 * vertices));
    this.cameras = header.cameras.map((name, k) => {
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, 1, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, new Uint8Array([40, 40, 40]));
      for (const [what, how] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
        [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]]) gl.texParameteri(gl.TEXTURE_2D, what, how);
      const part = values.subarray(3 * vertices * (k + 1), 3 * vertices * (k + 2));
      return { name, texture, source: buffer(gl.ARRAY_BUFFER, part), gain: [1, 1, 1] };
    });
    const indices = new Uint16Array(6 * (rows - 1) * (columns - 1));
    let n = 0;
    for (let i = 0; i + 1 < rows; i++) for (let j = 0; j + 1 < columns; j++) {
      const a = i * columns + j, b = a + columns;
      indices.set([a, b, a + 1, a + 1, b, b + 1], n); n += 6;
    }
    this.indices = buffer(gl.ELEMENT_ARRAY_BUFFER, indices);
    this.count = indices.length; this.rig_from_mesh = Bowl.transposed(header.level_from_rig);
  }

  setPictures(header, pictures) {
    const gl = this.gl;
    this.tilt = Bowl.product(header.level_from_rig, this.rig_from_mesh);
    pictures.forEach((picture, k) => {
      const camera = this.cameras[k];
      if (!camera) return;
      camera.gain = [...header.gains[k]].reverse();  // BGR there, RGB here
      gl.bindTexture(gl.TEXTURE_2D, camera.texture);
      if (picture) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, picture);
      else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, 1, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, new Uint8Array([40, 40, 40]));
    });
  }

  draw() {
    const gl = this.gl, canvas = this.canvas;
    const width = Math.round(canvas.clientWidth), height = Math.round(canvas.clientHeight);
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height); gl.clearColor(0.06, 0.08, 0.1, 1); gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix4fv(this.at.screen_from_level, false, this.matrix(width / Math.max(height, 1)));
    gl.enable(gl.BLEND); gl.blendFunc(gl.ONE, gl.ONE);  // weights sum to one
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.indices);
    gl.activeTexture(gl.TEXTURE0); gl.uniform1i(this.at.picture, 0);
    for (const camera of this.cameras) {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.places); gl.enableVertexAttribArray(this.at.place);
      gl.vertexAttribPointer(this.at.place, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, camera.source); gl.enableVertexAttribArray(this.at.source);
      gl.vertexAttribPointer(this.at.source, 3, gl.FLOAT, false, 0, 0);
      gl.uniform3fv(this.at.gain, camera.gain); gl.bindTexture(gl.TEXTURE_2D, camera.texture);
      gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_SHORT, 0);
    }
    document.body.dataset.bowl_draws = String(++this.draws);
  }

  // column-major projection * view * tilt
  matrix(aspect) {
    const e = this.elevation, a = this.azimuth, c = Math.cos(e);
    const back = [c * Math.cos(a), -c * Math.sin(a), Math.sin(e)];
    const right = [Math.sin(a), Math.cos(a), 0];
    const up = [back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2], back[0] * right[1] - back[1] * right[0]];
    const f = 1 / Math.tan(0.6), near = 0.1, far = 400, t = this.tilt;
    const wide = f / Math.max(aspect, 1), high = f * Math.min(aspect, 1);
    const view = [right, up, back].map((row) => [0, 1, 2].map((k) => row[0] * t[k] + row[1] * t[3 + k] + row[2] * t[6 + k]));
    const m = new Float32Array(16), depth = (far + near) / (near - far);
    for (let k = 0; k < 3; k++) {
      m[4 * k] = view[0][k] * wide; m[4 * k + 1] = view[1][k] * high;
      m[4 * k + 2] = view[2][k] * depth; m[4 * k + 3] = -view[2][k];
    }
    m[14] = -this.distance * depth + 2 * far * near / (near - far); m[15] = this.distance;
    return m;
  }

  static transposed(R) { return [R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]]; }

  static product(A, B) {
    const C = [];
    for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++)
      C.push(A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j]);
    return C;
  }
}
Bowl.VERTEX = `
attribute vec3 place; attribute vec3 source; uniform mat4 screen_from_level; varying vec3 at;
void main() { gl_Position = screen_from_level * vec4(place, 1.0); at = source; }`;
Bowl.FRAGMENT = `
precision mediump float; varying vec3 at; uniform sampler2D picture; uniform vec3 gain;
void main() {
  if (at.z <= 0.0 || at.x < 0.0 || at.y < 0.0 || at.x > 1.0 || at.y > 1.0) discard;
  gl_FragColor = vec4(texture2D(picture, at.xy).rgb * gain * at.z, 1.0);
}`;
