// Opens a page of `motiongen view` in a headless browser, tries its controls, and takes pictures.
//
// Usage: node view_screenshot.mjs PAGE.html PICTURE.png [SECONDS]
// Needs playwright-core (npm) and Chromium: CHROMIUM=/path/to/chromium, or the one of playwright.
// Writes PICTURE.png and, for dark screens, PICTURE.dark.png; ends with 1 if anything is wrong.

import path from 'node:path';
import { pathToFileURL } from 'node:url';
import { chromium } from 'playwright-core';

const [page_path, picture, seconds = '1'] = process.argv.slice(2);
if (!page_path || !picture) {
  console.error('usage: node view_screenshot.mjs PAGE.html PICTURE.png [SECONDS]');
  process.exit(2);
}
const url = pathToFileURL(path.resolve(page_path)).href;
const wrong = [];
const check = (is_right, what) => {
  if (!is_right) wrong.push(what);
};

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM || undefined,
  args: [
    '--autoplay-policy=no-user-gesture-required', '--no-sandbox', '--enable-precise-memory-info',
    '--js-flags=--expose-gc',
  ],
});
for (const colorScheme of ['light', 'dark']) {
  const context = await browser.newContext({
    colorScheme, viewport: { width: 1280, height: 1100 }, offline: true,
  });
  const page = await context.newPage();
  page.on('pageerror', (error) => wrong.push(`error in the page: ${error}`));
  page.on('console', (message) => {
    if (message.type() === 'error') wrong.push(`console: ${message.text()}`);
  });
  page.on('request', (request) => {
    const asked = request.url();
    check(asked === url || /^(data|blob):/.test(asked), `asks for ${asked}`);
  });
  await page.goto(url);
  await page.waitForFunction(() => window.motiongenReady === true, undefined, { timeout: 60_000 });
  // Pages of any length play their audio, from a file in memory and without the text that it came as.
  if (await page.evaluate(() => document.getElementById('audio') !== null)) {
    await page.waitForFunction(() => {
      const audio = document.getElementById('audio');
      return audio.src.startsWith('blob:') && audio.duration > 0;
    }, undefined, { timeout: 60_000 });
    const [heard, heap_mb] = await page.evaluate(() => {
      globalThis.gc?.();
      return [document.getElementById('audio').duration, performance.memory.usedJSHeapSize / 1e6];
    });
    check(heap_mb < 64, `holds ${heap_mb.toFixed(0)} MB beside its audio`);
    console.log(`audio: ${heard.toFixed(2)} s, heap ${heap_mb.toFixed(0)} MB`);
  }
  // A little past the frame's begin, as a clock is.
  const time = Number(seconds);
  const frame = await page.evaluate((s) => {
    window.motiongen.seek(s);
    return window.motiongen.frame();
  }, time);
  check(frame === Math.floor(time * 30 + 1e-6), `at ${time} s it shows frame ${frame}`);

  if (colorScheme === 'light') {
    await page.evaluate(() => window.motiongen.play());
    await page.waitForTimeout(1000);
    const played = await page.evaluate(() => {
      window.motiongen.pause();
      return window.motiongen.frame();
    });
    check(played > frame, `after a second of playing it shows frame ${played}`);
    await page.keyboard.press('Home');
    check(await page.evaluate(() => window.motiongen.frame()) === 0, 'Home is not the begin');
    await page.keyboard.press('.');
    check(await page.evaluate(() => window.motiongen.frame()) === 1, '. is not the next frame');
    await page.keyboard.press('Space');
    check(await page.evaluate(() => window.motiongen.isPlaying()), 'the space bar does not play');
    await page.keyboard.press('Space');
    check(!(await page.evaluate(() => window.motiongen.isPlaying())), 'nor does it pause');
    await page.evaluate((s) => window.motiongen.seek(s), time);
  }
  // Something is drawn: the stage has more than its background.
  const n_colors = await page.evaluate(() => {
    const canvas = document.getElementById('stage');
    const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
    const colors = new Set();
    for (let i = 0; i < data.length; i += 4) {
      colors.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2]);
    }
    return colors.size;
  });
  check(n_colors > 10, `the stage has ${n_colors} colours`);
  const file = colorScheme === 'light' ? picture : picture.replace(/(\.png)?$/, '.dark.png');
  await page.screenshot({ path: file, fullPage: true });
  await context.close();
  console.log(`${file}: frame ${frame}`);
}
await browser.close();
wrong.forEach((what) => console.error(what));
process.exit(wrong.length > 0 ? 1 : 0);
