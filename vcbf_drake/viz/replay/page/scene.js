// What the page adds to Meshcat's scene: growing trails, labels and the camera.
// It uses Meshcat's page global `viewer`: scene, scene_tree, camera, controls, animator.

const THREE = MeshCat.THREE;
const FILLED = 0.94; // How much of the pane the scene fills.
const GHOST = 0.35; // The opacity of ghosts.
const OUTLINE = 2.5; // How thick the outlines of ghosts are [pixels].

/** A point of Drake's world, z up, as Three.js has it, y up. */
function toThree([x, y, z]) {
  return new THREE.Vector3(x, z, -y);
}

/** The point at a (fractional) frame of a path. */
function pointAt(path, frame) {
  const k = Math.min(Math.floor(frame), path.length - 1);
  const next = path[Math.min(k + 1, path.length - 1)];
  return path[k].map((value, axis) => value + (frame - k) * (next[axis] - value));
}

/** The way through the places of all frames, at equal times; Three.js goes by length. */
class Way extends THREE.Curve {
  constructor(path) {
    super();
    this.path = path;
  }

  getPointAt(share) {
    return new THREE.Vector3(...pointAt(this.path, share * (this.path.length - 1)));
  }

  /** The direction in which a place was reached; where the way rests, that from before. */
  getTangentAt(share) {
    const last = this.path.length - 1;
    const step = (k) => this.getPointAt((k + 1) / last).sub(this.getPointAt(k / last));
    let k = Math.max(Math.round(share * last) - 1, 0);
    while (k > 0 && !step(k).length()) k -= 1;
    while (k < last - 1 && !step(k).length()) k += 1;
    return step(k).length() ? step(k).normalize() : new THREE.Vector3(1, 0, 0);
  }
}

/** A tube along a way up to a frame. */
class Trail {
  constructor({ path, color, ghost }, radius) {
    this.path = path;
    this.radius = radius * (ghost ? 0.7 : 1);
    this.mesh = new THREE.Mesh(undefined, new THREE.MeshPhongMaterial({ color }));
  }

  show(frame) {
    const segments = this.path.length - 1;
    if (segments < 1) return;
    if (this.segments !== segments) {
      this.segments = segments; // A run that goes on gets more of them.
      this.mesh.geometry.dispose();
      this.mesh.geometry = new THREE.TubeGeometry(new Way(this.path), segments, this.radius, 6);
      viewer.scene.add(this.mesh); // Its axes are Drake's.
    }
    const { geometry } = this.mesh; // Its triangles are in the order of the frames.
    geometry.setDrawRange(0, Math.floor((frame / segments) * geometry.index.count));
  }
}

class ReplayScene {
  constructor(data, pane, labels) {
    this.data = data;
    this.pane = pane;
    this.follows = false;
    this.fitted = true;
    this.pixel = { value: 0 }; // The size of a pixel at a distance of 1 m [m].
    // The colours on the screen are those of the legend.
    viewer.renderer.toneMapping = THREE.NoToneMapping;
    this.trails = [...data.runs, ...data.trails].map((way) => new Trail(way, data.sizes.trail));
    this.labels = data.labels.map((label) => this.makeLabel(label, labels));
    this.runLabels = data.runs.map((run) => {
      const node = this.makeLabel({ text: run.label, kind: "run" }, labels);
      node.style.background = run.color;
      return node;
    });
  }

  makeLabel(label, parent) {
    const node = parent.appendChild(document.createElement("span"));
    node.textContent = label.text;
    node.className = label.kind;
    return node;
  }

  /** Shows the scene at a time [s]. */
  show(time) {
    const frame = time * this.data.frames_per_second;
    this.finishMaterials();
    this.outlineGhosts();
    if (!this.data.live) this.seek(time);
    this.trails.forEach((trail) => trail.show(frame));
    if (this.follows) this.followTo(frame);
    viewer.set_dirty();
  }

  /**
   * Moves everything to where it is at a time [s]. Three.js writes only what has changed
   * since it wrote last; a pose that Meshcat has set meanwhile it would leave. So it begins
   * anew: from the poses as they are, all of them are written.
   */
  seek(time) {
    const { animator } = viewer;
    animator.mixer.stopAllAction();
    animator.play();
    animator.pause(); // The page's own clock leads.
    animator.seek(time);
    animator.display_progress(time);
  }

  /** Objects arrive one by one after the page has loaded; each is finished once. */
  finishMaterials() {
    viewer.scene.traverse((mesh) => {
      if (!mesh.isMesh || mesh.material.userData.finished) return;
      if (mesh.material.isMeshStandardMaterial && !mesh.material.map) {
        // Of a glTF model: shaded as everything else is.
        mesh.material = new THREE.MeshPhongMaterial({ color: mesh.material.color });
      }
      const material = mesh.material;
      if (mesh.geometry.type === "SphereGeometry" && this.data.round) {
        mesh.geometry = new THREE.SphereGeometry(mesh.geometry.parameters.radius, 48, 32);
      }
      material.userData.finished = true;
      material.flatShading = false;
      material.shininess = 22;
      mesh.castShadow = material.opacity > 0.3;
      mesh.receiveShadow = !material.transparent;
      if (material.transparent) {
        material.side = THREE.FrontSide;
        material.depthWrite = false;
      }
      material.needsUpdate = true;
    });
  }

  /**
   * Gives every ghost an outline in its colour: a hull behind it, thicker by some pixels.
   * So both are seen where it is inside the vehicle that it is a ghost of.
   */
  outlineGhosts() {
    this.data.runs.forEach((run, index) => {
      if (!run.ghost) return;
      const node = viewer.scene_tree.find(["drake", "vehicle", String(index)]);
      const meshes = [];
      node.object.traverse((mesh) => {
        if (mesh.isMesh && !mesh.userData.outlined) meshes.push(mesh);
      });
      for (const mesh of meshes) {
        const hull = new THREE.Mesh(mesh.geometry, this.hullMaterial(run.color));
        for (const each of [mesh, hull]) each.userData.outlined = true;
        mesh.material.transparent = true;
        mesh.material.opacity = GHOST;
        mesh.material.depthWrite = mesh.castShadow = false;
        mesh.material.polygonOffset = true; // Where both touch, the solid one is in front.
        mesh.material.polygonOffsetFactor = mesh.material.polygonOffsetUnits = 4;
        mesh.add(hull);
      }
    });
  }

  hullMaterial(color) {
    const material = new THREE.MeshBasicMaterial({ color, side: THREE.BackSide });
    material.userData.finished = true;
    material.onBeforeCompile = (shader) => {
      shader.uniforms.pixel = this.pixel;
      shader.vertexShader = "uniform float pixel;\n" + shader.vertexShader.replace(
        "#include <begin_vertex>",
        `float depth = -(modelViewMatrix * vec4(position, 1.0)).z;
         vec3 transformed = position + normalize(normal)
           * ${OUTLINE.toFixed(1)} * pixel * depth / length(modelMatrix[0].xyz);`,
      );
    };
    return material;
  }

  /** Marks the runs that have less than the least volume at present. */
  mark(tight) {
    tight.forEach((on, k) => {
      this.runLabels[k].textContent = this.data.runs[k].label + (on ? "  Vᵥ < 0" : "");
      this.runLabels[k].classList.toggle("tight", on);
    });
  }

  /** Moves the labels to where their things are on the screen. */
  placeLabels(time) {
    const frame = time * this.data.frames_per_second;
    const taken = [];
    const place = (ghost, side) => this.data.runs.forEach((run, k) => {
      if (run.ghost === ghost) {
        this.placeLabel(this.runLabels[k], pointAt(run.path, frame), side, taken);
      }
    });
    place(false, -1);
    for (const run of this.data.runs.filter((each) => !each.ghost)) {
      const { x, y } = this.onScreen(pointAt(run.path, frame));
      taken.push({ x: x - 16, y: y - 10, width: 32, height: 20 }); // The vehicle itself.
    }
    this.data.labels.forEach((label, k) =>
      this.placeLabel(this.labels[k], label.position, label.side, taken));
    place(true, 1);
  }

  /**
   * Puts a label above (side -1), on (0) or below (1) a point, clear of those taken; below
   * where there is no room above, and inside the pane if its point is.
   */
  placeLabel(node, point, side, taken) {
    const place = this.onScreen(point);
    const edge = this.onScreen([point[0], point[1], point[2] + this.reach(node)]);
    const box = { width: node.offsetWidth, height: node.offsetHeight };
    const away = Math.abs(edge.y - place.y) + 0.5 * box.height + 3;
    if (place.y - away - 0.5 * box.height < 0) side = Math.abs(side);
    box.x = place.x - 0.5 * box.width;
    box.y = place.y - 0.5 * box.height + side * away;
    const clash = () => taken.find((other) =>
      Math.abs(other.x + 0.5 * other.width - place.x) < 0.5 * (other.width + box.width)
      && Math.abs(other.y - box.y) < other.height);
    for (let other = clash(); other && side; other = clash()) {
      box.y = other.y + side * (other.height + 1);
    }
    const { clientWidth: width, clientHeight: height } = this.pane;
    const seen = place.depth < 1 && place.x > 0 && place.x < width && place.y > 0 && place.y < height;
    if (seen) {
      box.x = Math.min(Math.max(box.x, 2), width - box.width - 2);
      box.y = Math.min(Math.max(box.y, 2), height - box.height - 2);
      taken.push(box);
    }
    node.style.transform = `translate(${Math.round(box.x)}px, ${Math.round(box.y)}px)`;
    node.style.visibility = seen ? "visible" : "hidden";
  }

  /** How far what a label names reaches up and down [m]. */
  reach(node) {
    const { vehicle, marker } = this.data.sizes;
    return node.classList.contains("run") ? vehicle : marker;
  }

  /** Where a point is on the pane [pixels]. */
  onScreen(point) {
    const { x, y, z } = toThree(point).project(viewer.camera);
    const { clientWidth: width, clientHeight: height } = this.pane;
    return { x: (0.5 + 0.5 * x) * width, y: (0.5 - 0.5 * y) * height, depth: z };
  }

  /**
   * Fits again when what the view was fitted to is no more. Meshcat's camera gets its
   * field of view, and the pane its size, at any time after this script has run.
   */
  keepFitted() {
    if (this.controls !== viewer.controls) {
      this.controls = viewer.controls;
      this.controls.addEventListener("start", () => { this.fitted = false; });
    }
    const moved = () => viewer.camera.position.distanceTo(this.place) > 1e-6 * this.data.camera.span;
    if (this.fitted && (this.lens() !== this.fittedLens || moved())) this.fit();
  }

  /** What decides how far away the camera has to be, as text to compare. */
  lens() {
    const { uuid, fov } = viewer.camera;
    return [uuid, fov, this.pane.clientWidth, this.pane.clientHeight].join();
  }

  /** Brings everything into view, from the side the page was made for. */
  fit() {
    this.fitted = true;
    this.follows = false;
    if (!this.pane.clientWidth || !this.pane.clientHeight) return; // Not in sight yet.
    const points = this.data.camera.points.map(toThree);
    const toward = toThree(this.data.camera.direction).normalize();
    const right = new THREE.Vector3(0, 1, 0).cross(toward).normalize();
    const up = toward.clone().cross(right);
    // Along each axis of the screen, two sides of the pyramid of sight touch the points: how
    // far back its tip is then, and where it may be across.
    const slope = FILLED * this.slope();
    const aspect = this.pane.clientWidth / this.pane.clientHeight;
    const touch = (axis, slope) => {
      const most = (sign) => Math.max(
        ...points.map((point) => sign * point.dot(axis) + slope * point.dot(toward)));
      const [ahead, behind] = [most(1), most(-1)];
      return { back: (ahead + behind) / (2 * slope), across: (ahead - behind) / 2, slope };
    };
    const [x, y] = [touch(right, slope * aspect), touch(up, slope)];
    const back = Math.max(x.back, y.back);
    // What room there is goes to the top left, where the card is.
    const room = (side) => side.slope * (back - side.back);
    const distance = back - points[0].dot(toward);
    const target = toward.clone().multiplyScalar(points[0].dot(toward))
      .addScaledVector(right, x.across - 0.45 * room(x))
      .addScaledVector(up, y.across + 0.6 * room(y));
    this.look(target, toward.multiplyScalar(distance));
    this.fittedLens = this.lens();
    this.place = viewer.camera.position.clone();
  }

  /** Half the height that the camera sees at a distance of 1 m [m]. */
  slope() {
    return Math.tan((0.5 * viewer.camera.fov * Math.PI) / 180);
  }

  look(target, offset) {
    viewer.controls.target.copy(target);
    viewer.camera.position.copy(target).add(offset);
    viewer.camera.lookAt(target);
    viewer.camera.updateMatrixWorld();
    viewer.camera.updateProjectionMatrix(); // The labels use it before Meshcat draws.
    this.pixel.value = this.slope() / (0.5 * Math.max(this.pane.clientHeight, 1));
    viewer.set_dirty();
  }

  /** Starts or ends following the chosen run's vehicle. */
  setFollow(on, time) {
    if (!on) return this.fit();
    this.follows = true;
    this.fitted = false;
    const frame = time * this.data.frames_per_second;
    const target = toThree(pointAt(this.data.primary.path, frame));
    const toward = toThree(this.data.camera.direction).normalize();
    this.look(target, toward.multiplyScalar(0.5 * this.data.camera.span));
  }

  followTo(frame) {
    const target = toThree(pointAt(this.data.primary.path, frame));
    const offset = viewer.camera.position.clone().sub(viewer.controls.target);
    this.look(target, offset);
  }
}
