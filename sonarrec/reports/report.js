// A click on a chart over time, or on a frame's number, shows the frame: the nearest in this page.
(() => {
  const logs = JSON.parse(document.getElementById("frames").textContent);
  const part = (name) => document.getElementById("viewer-" + name);
  const viewer = document.getElementById("viewer");
  const svg = part("marks"), image = new Image();
  image.id = "viewer-image";
  svg.before(image);
  const view = new View(svg, image);
  let now = null; // {log: index, n: into its frames}

  function show(log, n, note) {
    const of = logs[log], frame = of.frames[n];
    now = { log, n };
    const method = part("method");
    const said = frame.said[of.methods.indexOf(method.value)] || [];
    const [width, height] = frame.size;
    const declared = said.filter((o) => o.declared).map((o) => o.label.replace(/ +/, " ("));
    const when = of.unit ? `, ${frame.at.toFixed(2)} ${of.unit}` : "";
    part("title").textContent = (logs.length > 1 ? `${of.name}, frame ` : "Frame ") + frame.frame + when;
    part("note").textContent = note || "";
    image.src = frame.image;
    image.width = width;
    image.height = height;
    image.alt = `Sonar image, frame ${frame.frame}: ${method.value} ` +
      (declared.length ? `declares ${declared.join("), ")})` : "declares nothing");
    part("back").disabled = n === 0;
    part("on").disabled = n === of.frames.length - 1;
    view.begin(width, height);
    for (const outline of said) view.mark(outline, outline.declared ? "declared" : "other");
    for (const outline of frame.truth) view.mark(outline, "truth", true);
    viewer.hidden = false;
    for (const chart of document.querySelectorAll("[data-low]")) {
      const share = (frame.at - chart.dataset.low) / (chart.dataset.high - chart.dataset.low);
      const line = chart.querySelector(".now") || document.createElement("i");
      line.className = "now";
      line.hidden = Number(chart.dataset.log) !== log || share < 0 || share > 1;
      line.style.left = 100 * share + "%";
      chart.append(line);
    }
  }

  function nearest(frames, key, value) {
    let best = 0;
    frames.forEach((frame, n) => {
      if (Math.abs(frame[key] - value) < Math.abs(frames[best][key] - value)) best = n;
    });
    return best;
  }

  document.addEventListener("click", (event) => {
    const target = event.target.closest("[data-log]");
    if (!target) return;
    const log = Number(target.dataset.log), of = logs[log];
    const method = part("method");
    method.replaceChildren(...of.methods.map((name) => new Option(name, name)));
    method.value = target.dataset.method;
    if (method.selectedIndex < 0) method.selectedIndex = 0;
    if (target.dataset.frame !== undefined) {
      const asked = Number(target.dataset.frame);
      const n = nearest(of.frames, "frame", asked);
      const got = of.frames[n].frame;
      show(log, n, got === asked ? "" : `Frame ${asked} is not in this page; the nearest is.`);
      return;
    }
    const box = target.getBoundingClientRect();
    const low = Number(target.dataset.low), high = Number(target.dataset.high);
    const at = low + ((event.clientX - box.left) / box.width) * (high - low);
    const asked = of.unit ? `${at.toFixed(2)} ${of.unit}` : `frame ${Math.round(at)}`;
    show(log, nearest(of.frames, "at", at), `The nearest in this page to ${asked}.`);
  });

  const step = (by) => {
    if (now && logs[now.log].frames[now.n + by]) show(now.log, now.n + by);
  };
  const close = () => {
    viewer.hidden = true;
    now = null;
    document.querySelectorAll(".now").forEach((line) => line.remove());
  };
  part("back").addEventListener("click", () => step(-1));
  part("on").addEventListener("click", () => step(1));
  part("method").addEventListener("change", () => show(now.log, now.n));
  part("close").addEventListener("click", close);
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") close();
    if (event.target.closest("select, .scroll")) return;
    if (event.key === "ArrowLeft") step(-1);
    if (event.key === "ArrowRight") step(1);
  });
  document.querySelectorAll("button.frame").forEach((button) => { button.disabled = false; });
  document.documentElement.classList.add("scripted");
})();
