#!/bin/sh
# Checks the operator's page: types (TypeScript, from the JSDoc comments) and lint (ESLint). Both are installed under
# tests/console/js from its package-lock.json. The page itself needs neither, so a machine without Node skips the check.
cd "$(dirname "$0")/.." || exit 1
tools=tests/console/js
skip() {
  echo "JavaScript NOT checked: $1"
  exit 0
}
node -e 'process.exit(process.versions.node.split(".")[0] < 20 ? 1 : 0)' 2>/dev/null || skip "Node.js 20 or newer is missing"
command -v npm >/dev/null || skip "npm is missing"
if ! cmp -s $tools/package-lock.json $tools/node_modules/.installed-lock; then
  (cd $tools && npm ci --silent --no-audit --no-fund --ignore-scripts) || skip "npm could not install $tools/package-lock.json"
  cp $tools/package-lock.json $tools/node_modules/.installed-lock
fi
$tools/node_modules/.bin/tsc --project $tools &&
  $tools/node_modules/.bin/eslint --max-warnings 0 --config $tools/eslint.config.js $tools instant_ic/console/static
