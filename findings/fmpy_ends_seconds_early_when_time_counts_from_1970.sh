#!/bin/sh
# Good guess: FMPy runs from start_time to stop_time, also where these are the stamps of a bag, in seconds since 1970.
# Really: two times are the same to it that differ by less than 1e-9 of their value, which is 1.76 s today. The last
# 1.76 s are not run, and a run that is shorter has one row. Nothing is said.
# FMPy 0.3.32, fmpy/simulation.py: simulateCS, "isclose(time, stop_time)", with math.isclose as it is.
# Met by: who gives an exported controller the stamps of a bag. Needs a C compiler (cc), for a unit that repeats its input.
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

begin = 1_760_000_000.0
found = {}
for name, start in (("from 0 on", 0.0), ("since 1970", begin)):
    for length in (1.0, 10.0):
        rows = fmpy.simulate_fmu(
            str(Path("unit").resolve()), start_time=start, stop_time=start + length, output_interval=0.01, output=["voltage"]
        )
        found[name, length] = len(rows), rows["time"][-1] - start
print(f"FMPy {version('FMPy')}, steps of 0.01 s")
for (name, length), (count, last) in found.items():
    print(f"times {name}, {length:g} s: {count} rows, the last at {last:.2f} s")
if [found["from 0 on", n][0] for n in (1.0, 10.0)] != [101, 1001]:
    sys.exit("the behaviour has changed: small times")
if found["since 1970", 1.0][0] != 1 or not 8.2 < found["since 1970", 10.0][1] < 8.3:
    sys.exit("the behaviour has changed: large times")
PY
