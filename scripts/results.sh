#!/usr/bin/env bash
# Measure every figure of docs/results.md anew, offline: scripts/results.sh FOLDER (a new one).
set -euo pipefail

[ $# -eq 1 ] || { sed -n '2s/^# //p' "${BASH_SOURCE[0]}" >&2; exit 2; }
[ ! -e "$1" ] || { echo "netpos: $1 exists; choose a new folder" >&2; exit 1; }
# shellcheck source=env.sh
[ -n "${NETPOS_ROOT:-}" ] || { set +u; . "$(dirname "${BASH_SOURCE[0]}")/../env.sh"; set -u; }
mkdir -p "$1"
out=$(cd "$1" && pwd)
data=${NETPOS_DATA:-$NETPOS_ROOT/../shared/data}

for scenario in metis_madrid fast_pass fast_pass_100hz intersection_turn intersection_turn_30m blocked_5g_drive; do
  netpos run "$scenario" --offline --bag "$out/$scenario" >/dev/null
  netpos evaluate "$out/$scenario" --json "$out/$scenario.json" >/dev/null
done
if [ -d "$data" ]; then
  for run in uc1_run1 uc1_run2 uc2_run1; do
    netpos import ble-aoa "$data/ble_aoa" "$out/ble_$run.in" --run "$run" >/dev/null
    netpos replay "$out/ble_$run.in" --out "$out/ble_$run" >/dev/null
    netpos evaluate "$out/ble_$run" --json "$out/ble_$run.json" >/dev/null
  done
  for run in LOS NLOS; do
    netpos import uwb-anchors "$data/uwb_car_anchors/$run" "$out/uwb_$run.in" >/dev/null
    netpos replay "$out/uwb_$run.in" --out "$out/uwb_$run" >/dev/null
    netpos evaluate "$out/uwb_$run" --json "$out/uwb_$run.json" >/dev/null
  done
  netpos import uwb-trolley "$data/uwb_trolley" "$out/uwb_trolley.in" >/dev/null
  netpos replay "$out/uwb_trolley.in" --out "$out/uwb_trolley" >/dev/null
  netpos evaluate "$out/uwb_trolley" --json "$out/uwb_trolley.json" >/dev/null
  netpos import car-imu-rtk "$data/car_imu_rtk" "$out/car_imu_rtk.in" >/dev/null
  netpos replay "$out/car_imu_rtk.in" --out "$out/car_imu_rtk" >/dev/null
  netpos evaluate "$out/car_imu_rtk" --json "$out/car_imu_rtk.json" >/dev/null
else
  echo "netpos: no real recordings at $data, so only the simulations were measured" >&2
fi

python - "$out" <<'PYTHON'
import json
import sys
from pathlib import Path

print("| run | n | RMSE m | mean m | p95 m | max m | clock sd ns | NEES (bounds) | rejected |")
print("|---|---|---|---|---|---|---|---|---|")
for path in sorted(Path(sys.argv[1]).glob("*.json")):
    for f in json.loads(path.read_text())["vues"].values():
        sd = f["clock_offset_sd_ns"]
        bounds = "–" if f["nees_bounds"] is None else "{:.2f}–{:.2f}".format(*f["nees_bounds"])
        cells = [path.stem, f["n"]]
        cells += [f"{f[k]:.3f}" for k in ("rmse_m", "mean_error_m", "p95_m", "max_m")]
        cells += ["–" if sd is None else f"{sd:.2f}", f"{f['nees_mean']:.2f} ({bounds})", f["rejected"]]
        print("|", " | ".join(map(str, cells)), "|")
PYTHON
