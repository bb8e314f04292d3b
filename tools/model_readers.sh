#!/bin/sh
# Fetches into a folder what models and reports are opened with in tests: the Khronos validator and
# three.js; axe and what drives a browser.
set -eu
folder=$1
if ! command -v npm >/dev/null; then
  echo "no npm: models and reports are not opened by other people's programs (apt install npm)"
  exit 0
fi
mkdir -p "$folder"
cd "$folder"
if ! npm install --no-audit --no-fund --silent --no-save \
  gltf-validator@2.0.0-dev.3.10 three@0.187.0 axe-core@4.14.1 puppeteer-core@24.43.1; then
  echo "npm cannot fetch them: models and reports are not opened by other people's programs"
  cd / && rm -rf "$OLDPWD"
fi
