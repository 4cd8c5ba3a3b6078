#!/bin/sh
# Good guess: FMPy runs a unit that proposes a step of 0.1 ms, with setpoints recorded every 5 ms, at one of these two.
# Really: without output_interval it doubles the proposed step until at most 1000 are left. A run of 209 s has steps of
# 0.4096 s; the setpoints between are never set, and a pulse of 0.3 s leaves no trace.
# FMPy 0.3.32, fmpy/simulation.py: simulate_fmu, "output_interval *= 2", and simulateCS.
# Met by: who runs an exported controller on a recorded path. Needs a C compiler (cc), for a unit that repeats its input.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check FMPy==0.3.32 numpy==2.4.6
cd "$folder"
cat >unit.c <<'C'
#include <stddef.h>
#include <stdlib.h>
/* FMI 2.0: reference 0 is the input, 1 the output, which is the input of the last step. */
void *fmi2Instantiate(const char *n, int t, const char *g, const char *r, const void *c, int v, int l) { return calloc(2, sizeof(double)); }
void fmi2FreeInstance(void *u) { free(u); }
int fmi2SetupExperiment(void *u, int a, double b, double c, int d, double e) { return 0; }
int fmi2EnterInitializationMode(void *u) { return 0; }
int fmi2ExitInitializationMode(void *u) { return 0; }
int fmi2Terminate(void *u) { return 0; }
int fmi2SetReal(void *u, const unsigned *at, size_t n, const double *x) { for (size_t k = 0; k < n; k++) ((double *)u)[at[k]] = x[k]; return 0; }
int fmi2GetReal(void *u, const unsigned *at, size_t n, double *x) { for (size_t k = 0; k < n; k++) x[k] = ((double *)u)[at[k]]; return 0; }
#define ABSENT(name) int fmi2##name(void) { return 3; }
ABSENT(Reset) ABSENT(GetInteger) ABSENT(GetBoolean) ABSENT(GetString) ABSENT(SetInteger) ABSENT(SetBoolean)
ABSENT(SetString) ABSENT(GetFMUstate) ABSENT(SetFMUstate) ABSENT(FreeFMUstate) ABSENT(SerializedFMUstateSize)
ABSENT(SerializeFMUstate) ABSENT(DeSerializeFMUstate) ABSENT(GetDirectionalDerivative) ABSENT(SetDebugLogging)
ABSENT(SetRealInputDerivatives) ABSENT(GetRealOutputDerivatives) ABSENT(CancelStep) ABSENT(GetStatus)
ABSENT(GetRealStatus) ABSENT(GetIntegerStatus) ABSENT(GetBooleanStatus) ABSENT(GetStringStatus)
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
int fmi2DoStep(void *u, double t, double h, int f) { ((double *)u)[1] = ((double *)u)[0]; return 0; }
C
mkdir -p unit/binaries/linux64
cc -shared -fPIC -O1 unit.c -o unit/binaries/linux64/follow.so
cat >unit/modelDescription.xml <<'X'
<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="follow" guid="{1}">
  <CoSimulation modelIdentifier="follow" canHandleVariableCommunicationStepSize="true"/>
  <DefaultExperiment startTime="0" stopTime="1" stepSize="1e-4"/>
  <ModelVariables>
    <ScalarVariable name="desired" valueReference="0" causality="input" variability="continuous"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="voltage" valueReference="1" causality="output" variability="continuous"><Real/></ScalarVariable>
  </ModelVariables>
  <ModelStructure><Outputs><Unknown index="2"/></Outputs></ModelStructure>
</fmiModelDescription>
X
venv/bin/python - <<'PY'
import sys
from importlib.metadata import version
from pathlib import Path

import fmpy
import numpy as np

time = 0.005 * np.arange(41_801)
desired = np.where((time > 100.4) & (time < 100.7), 5e-6, 0.0)
recorded = np.array(list(zip(time, desired)), dtype=[("time", float), ("desired", float)])
rows = fmpy.simulate_fmu(str(Path("unit").resolve()), stop_time=209.0, input=recorded, output=["voltage"])
finer = fmpy.simulate_fmu(str(Path("unit").resolve()), stop_time=209.0, input=recorded, output=["voltage"], output_interval=0.005)
step = rows["time"][1] - rows["time"][0]
print(f"FMPy {version('FMPy')}: {len(recorded)} setpoints, {len(rows)} rows, step {step:.4f} s")
print(f"largest output {rows['voltage'].max():g}, with output_interval=0.005 {finer['voltage'].max():g}")
if not (abs(step - 0.4096) < 1e-9 and rows["voltage"].max() == 0.0 and finer["voltage"].max() == 5e-6):
    sys.exit("the behaviour has changed")
PY
