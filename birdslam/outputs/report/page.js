"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const slider = document.getElementById("at");
const words = document.getElementById("words");
const picture = document.getElementById("picture");
const dark = window.matchMedia("(prefers-color-scheme: dark)");
const config = { responsive: true, displaylogo: false, scrollZoom: true };
const ring = { name: "now", type: "scatter", mode: "markers", hoverinfo: "skip",
  marker: { size: 15, symbol: "circle-open", line: { width: 3 }, color: "#e8487f" } };
// The plots with a ring at the current frame
const plots = { map: { x: data.x, y: data.y, traces: data.map }, ...(data.earth ? { earth: data.earth } : {}) };

const below = { orientation: "h", yref: "container", y: 0, yanchor: "bottom" };

function layout(more) {
  const style = getComputedStyle(document.documentElement);
  const [ink, line, faint] = ["--ink", "--line", "--faint"].map((name) => style.getPropertyValue(name).trim());
  const axis = { gridcolor: line, zerolinecolor: line, automargin: true };
  const out = { paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: ink },
    margin: { l: 60, r: 15, t: 40, b: 60 }, modebar: { bgcolor: "rgba(0,0,0,0)", color: faint, activecolor: ink }, ...more };
  out.title = { text: more.title, font: { size: 14 }, x: 0.01, xanchor: "left" };
  out.xaxis = { ...axis, ...more.xaxis };
  out.yaxis = { ...axis, ...more.yaxis };
  return out;
}

const last = data.t[data.t.length - 1];
const cursor = (t) => [{ type: "line", x0: t, x1: t, yref: "paper", y0: 0, y1: 1,
  line: { color: "#e8487f", width: 2 } }];

function drawPlot(name, title, right, up, scaleratio, more) {
  const { x, y, traces } = plots[name];
  const here = { ...ring, x: [x[slider.value]], y: [y[slider.value]] };
  Plotly.react(name, [...traces, here], layout({ title, legend: below, ...more.around,
    xaxis: { title: { text: right }, ...more.axis },
    yaxis: { title: { text: up }, scaleanchor: "x", scaleratio, ...more.axis } }), config);
}

function draw() {
  const time = { title: { text: "time (s)" }, range: [0, last] };
  // Reserve room for a legend of several rows: plotly does not always do so
  const low = document.getElementById("map").clientWidth < 800 ? 120 : 80;
  drawPlot("map", "from above", "right of the start (m)", "ahead of the start (m)", 1,
    { around: { margin: { l: 60, r: 15, t: 40, b: low } } });
  if (data.earth) {
    // Fixed margins: automatic ones oscillate on a narrow screen
    drawPlot("earth", "north is up, colours as above", "longitude (deg)", "latitude (deg)", data.earth.aspect_ratio,
      { around: { showlegend: false, margin: { l: 90, r: 15, t: 40, b: 50 } },
        axis: { tickformat: ".4f", nticks: 5, automargin: false } });
  }
  Plotly.react("speed", data.speeds, layout({
    title: "speed (m/s)", legend: below,
    xaxis: time, yaxis: { rangemode: "tozero" }, shapes: cursor(data.t[slider.value]) }), config);
  Plotly.react("statuses", data.statuses, layout({
    title: "statuses", xaxis: time, shapes: cursor(data.t[slider.value]),
    yaxis: { automargin: true, autorange: "reversed", type: "category" } }), config);
}

function move() {
  const k = Number(slider.value);
  words.textContent = new DOMParser().parseFromString(data.words[k], "text/html").documentElement.textContent;
  for (const [name, { x, y, traces }] of Object.entries(plots)) {
    Plotly.restyle(name, { x: [[x[k]]], y: [[y[k]]] }, [traces.length]);
  }
  for (const name of ["speed", "statuses"]) Plotly.relayout(name, { shapes: cursor(data.t[k]) });
  if (picture && data.pictures.length) {
    let at = 0;
    while (at + 1 < data.pictures.length && data.pictures[at + 1].t <= data.t[k]) at += 1;
    picture.src = `data:image/jpeg;base64,${data.pictures[at].jpeg}`;
  }
}

// Two clicks on the road in a picture: their distance at the camera's height, and the height that a true length implies
const clicks = [];

function onRoad([x, y], tilt) {
  const { scale_px, focal_px, centre_px, height_m, normal, normal_sigma } = data.ruler;
  const ray = [(x * scale_px[0] - centre_px[0]) / focal_px[0], (y * scale_px[1] - centre_px[1]) / focal_px[1], 1];
  const down = ray.reduce((sum, part, k) => sum - part * (normal[k] + tilt * normal_sigma[k]), 0);
  return down > 0 ? ray.map((part) => part * height_m / down) : null;
}

function lengthOf([a, b], tilt) {
  const [p, q] = [onRoad(a, tilt), onRoad(b, tilt)];
  return p && q ? Math.hypot(...p.map((part, k) => part - q[k])) : NaN;
}

function measure() {
  const out = document.getElementById("measured");
  for (const dot of document.querySelectorAll(".dot")) dot.remove();
  for (const [x, y] of clicks) {
    const dot = document.createElement("i");
    dot.className = "dot";
    [dot.style.left, dot.style.top] = [`${picture.offsetLeft + x * picture.clientWidth}px`, `${picture.offsetTop + y * picture.clientHeight}px`];
    picture.parentElement.append(dot);
  }
  if (clicks.length < 2) { out.textContent = ""; return; }
  const length = lengthOf(clicks, 0);
  const moved = (k, axis) => clicks.map((at, i) => at.map((part, j) => part + (i === k && j === axis ? data.ruler.click : 0)));
  const changes = [lengthOf(clicks, 1), ...[[0, 0], [0, 1], [1, 0], [1, 1]].map((at) => lengthOf(moved(...at), 0))];
  const sigma = Math.hypot(...changes.map((other) => other - length)) / length;
  if (!(sigma < 1)) { out.textContent = "These points are above or too near the horizon."; return; }
  const percent = `${Math.max(1, Math.round(100 * sigma))} %`;
  const known = Number(document.getElementById("length").value);
  const height = data.ruler.height_m * known / length;
  out.textContent = `Measured: ${length.toFixed(2)} m \u00b1 ${percent}.`
    + (known > 0 ? ` For ${known} m pass --height ${height.toFixed(2)} (\u00b1 ${percent}).` : "");
}

if (picture && data.ruler) {
  picture.addEventListener("click", (event) => {
    const at = [event.offsetX / picture.clientWidth, event.offsetY / picture.clientHeight];
    const { scale_px, size_px } = data.ruler;
    if (at.some((part, k) => part * scale_px[k] > size_px[k])) return;  // beside the camera image
    if (clicks.length === 2) clicks.length = 0;
    clicks.push(at);
    measure();
  });
  document.getElementById("length").addEventListener("input", measure);
  slider.addEventListener("input", () => { clicks.length = 0; measure(); });
  window.addEventListener("resize", measure);
}

slider.max = String(data.t.length - 1);
slider.addEventListener("input", move);
dark.addEventListener("change", draw);
document.getElementById("statuses").style.height = `${160 + 26 * Math.max(1, data.statuses.length)}px`;
draw();
move();
for (const name of [...Object.keys(plots), "speed"]) {
  document.getElementById(name).on("plotly_click", (event) => {
    const point = event.points[0];
    let best = 0;
    data.t.forEach((t, k) => {
      const far = (i) => name === "speed" ? Math.abs(data.t[i] - point.x)
        : Math.hypot(plots[name].x[i] - point.x, plots[name].y[i] - point.y);
      if (far(k) < far(best)) best = k;
    });
    slider.value = String(best);
    move();
  });
}
document.documentElement.dataset.ready = "yes";
