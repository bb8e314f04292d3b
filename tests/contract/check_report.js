// Opens a report in Chromium: node check_report.js MODULES BROWSER PROFILE REPORT COLUMN ROW
// Prints JSON: accessibility violations, what controls do with and without scripts, requests.
// COLUMN and ROW name a pixel of the map's picture, whose coordinates are read.
const path = require("node:path");
const url = require("node:url");
const [modules, browserPath, profile, report, column, row] = process.argv.slice(2);
const puppeteer = require(path.join(modules, "puppeteer-core"));
const axe = require("node:fs").readFileSync(path.join(modules, "axe-core", "axe.min.js"), "utf8");
const flags = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
  "--disable-background-networking", "--disable-component-update", "--disable-sync"];
const requests = [], errors = [];

const open = async (browser, {scheme = "light", width = 1440, scripts = true} = {}) => {
  const page = await browser.newPage();
  page.on("request", (one) => requests.push(one.url().slice(0, 80)));
  page.on("pageerror", (error) => errors.push(error.message));
  page.on("console", (message) => errors.push(message.text()));
  await page.setJavaScriptEnabled(scripts);
  await page.setViewport({width, height: 900});
  await page.emulateMediaFeatures([{name: "prefers-color-scheme", value: scheme}]);
  await page.goto(url.pathToFileURL(report));
  return page;
};

const violations = async (browser, how) => {
  const page = await open(browser, how);
  // everything that can be seen
  await page.evaluate(() => {
    for (const one of document.querySelectorAll("details")) one.open = true;
    for (const one of document.querySelectorAll(".toggle:not(:checked)")) one.click();
  });
  await page.evaluate(axe); // as a script of the page it would be refused
  const found = await page.evaluate(() => axe.run(document, {resultTypes: ["violations"]}));
  const overflow = await page.evaluate(
    () => document.documentElement.scrollWidth - document.documentElement.clientWidth);
  await page.close();
  return {
    overflow,
    violations: found.violations.map(
      ({id, impact, nodes}) => [id, impact, nodes.slice(0, 3).map((node) => node.html.slice(0, 200))]),
  };
};

// zoom and place of the sheet, the first one of a section
const state = (page, section = ".main-map") => page.evaluate((section) => {
  const box = document.querySelector(`${section} .sheet`).getBoundingClientRect();
  return {left: box.left + scrollX, top: box.top + scrollY, width: box.width,
    scroll: scrollY, readout: document.querySelector(`${section} .readout`).textContent};
}, section);

const middle = (page, selector) => page.evaluate((selector) => {
  const box = document.querySelector(selector).getBoundingClientRect();
  return [box.left + box.width / 2, box.top + box.height / 2];
}, selector);

const driveMap = async (page) => {
  const out = {start: await state(page)};
  const [x, y] = await middle(page, ".main-map .viewport");
  const note = async (name) => { out[name] = await state(page); };
  await page.mouse.move(x, y);
  await page.mouse.wheel({deltaY: 120});
  await new Promise((done) => setTimeout(done, 300));
  await note("wheel");
  await page.evaluate(() => scrollTo(0, 0));
  await page.click(".main-map [data-do=in]");
  await note("button");
  await page.mouse.move(x, y);
  await page.mouse.down();
  await page.mouse.move(x + 70, y - 30, {steps: 3});
  await page.mouse.up();
  await note("drag");
  await page.mouse.wheel({deltaY: -120}); // the map has the focus now
  await note("focused");
  await page.keyboard.press("0");
  await note("all");
  await page.keyboard.press("+");
  await page.keyboard.press("ArrowLeft");
  await note("keys");
  const [px, py] = await page.evaluate((column, row) => {
    const image = document.querySelector(".written"), box = image.getBoundingClientRect();
    return [box.left + (column + 0.5) / image.naturalWidth * box.width,
      box.top + (row + 0.5) / image.naturalHeight * box.height];
  }, Number(column), Number(row));
  await page.mouse.move(px, py);
  await note("hover");
  return out;
};

const driveSlider = async (page) => {
  const split = () => page.evaluate(() => {
    const range = document.querySelector(".split input"), over = document.querySelector(".over");
    return {value: Number(range.value), clip: getComputedStyle(over).clipPath,
      pair: getComputedStyle(document.querySelector(".compare .pair")).display,
      images: document.querySelectorAll(".slider .sheet img").length};
  });
  const out = {start: await split()};
  await page.focus(".split input");
  await page.keyboard.press("ArrowRight");
  out.key = await split();
  await page.evaluate(() => document.querySelector(".divider").scrollIntoView({block: "center"}));
  const [x, y] = await middle(page, ".divider");
  const width = await page.evaluate(
    () => document.querySelector(".slider .viewport").getBoundingClientRect().width);
  await page.mouse.move(x, y);
  await page.mouse.down();
  await page.mouse.move(x - width / 5, y, {steps: 3});
  await page.mouse.up();
  out.drag = await split();
  return out;
};

const driveLayers = async (page) => {
  const names = await page.evaluate(() => ["dynamic", "thin", "path", "grid"].filter(
    (name) => document.querySelector(`#show-${name}`)));
  const shown = () => page.evaluate((names) => Object.fromEntries(names.map((name) => [name,
    getComputedStyle(document.querySelector(`.main-map .${name}`)).display !== "none"])), names);
  const out = {start: await shown()};
  for (const name of names) {
    await page.click(`label[for=show-${name}]`);
  }
  out.toggled = await shown();
  return out;
};

// a zoomed map as it is printed: the page gets another size after the script has drawn
const print = async (page) => {
  const shown = () => page.evaluate(() => {
    const stage = document.querySelector(".main-map .stage"), scale = stage.querySelector(".scale");
    return {window: stage.dataset.window.split(" ").map(Number), text: scale.textContent,
      bar: scale.getBoundingClientRect().width,
      sheet: stage.querySelector(".sheet").getBoundingClientRect().width};
  });
  await page.click(".main-map [data-do=in]");
  const before = await shown();
  await page.evaluate(() => dispatchEvent(new Event("beforeprint")));
  await page.emulateMediaType("print");
  await page.setViewport({width: 700, height: 900});
  const printed = await shown();
  await page.emulateMediaType("screen");
  await page.setViewport({width: 1440, height: 900});
  await page.evaluate(() => dispatchEvent(new Event("afterprint")));
  return {before, printed, after: await shown()};
};

const withoutScripts = (page) => page.evaluate(() => {
  const seen = (selector) => [...document.querySelectorAll(selector)].map(
    (one) => one.checkVisibility() && one.getBoundingClientRect().width > 100);
  return {map: seen(".main-map .written"), pair: seen(".compare .pair img"),
    controls: seen(".zoom, .slider, .readout")};
});

(async () => {
  const browser = await puppeteer.launch(
    {executablePath: browserPath, userDataDir: profile, args: flags});
  const out = {};
  try {
    out.light = await violations(browser);
    out.dark = await violations(browser, {scheme: "dark"});
    out.phone = await violations(browser, {width: 390});
    const page = await open(browser);
    out.layers = await driveLayers(page);
    out.map = await driveMap(page);
    if (await page.$(".compare")) out.slider = await driveSlider(page);
    out.print = await print(await open(browser));
    const plain = await open(browser, {scripts: false});
    out.plain = await withoutScripts(plain);
    out.plain.layers = await driveLayers(plain);
  } finally {
    await browser.close();
  }
  console.log(JSON.stringify({...out, requests, errors}));
})().catch((error) => { console.error(error); process.exit(1); });
