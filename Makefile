# tss: `make deps demo` for a first picture, `make deps test` for the tests; `make help` for the rest.

CC      ?= cc
CFLAGS  ?= -O3 -march=native -g
STD     := -std=c11
WARN    := -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wsign-conversion
BUILD   := build
OUT     := out
HEADERS := $(wildcard *.h)
VIEWERS := $(wildcard examples/*.h)
# OMP_NUM_THREADS or `--threads N` choose the threads; no result depends on them.

BREW := $(shell command -v brew >/dev/null 2>&1 && brew --prefix)
OPENMP := -fopenmp
LIBS   := $(if $(BREW),-L$(BREW)/lib) -lmetis -lm
ALL    := $(STD) $(CFLAGS) $(WARN) $(OPENMP) $(if $(BREW),-I$(BREW)/include) -I. -Iexamples -Itests $(DEFS)
# Tests compile the headers many times over: -O1 keeps that short, and bits do not depend on it.
TEST_CFLAGS ?= -O1 -march=native -g
JOBS := $(shell nproc 2>/dev/null || echo 2)

# Goals in the order given (deps before the rest); programs side by side in a make of their own.
ifndef PARALLEL
.NOTPARALLEL:
endif

.PHONY: help all deps demo report test test-programs examples run-examples bench bench-error sanitize fuzz nodeps compat clean

all: examples

help:
	@grep -E '^#: ' Makefile | sed 's/^#: //'

#: deps          install what is missing (apt, dnf or brew); nothing to do the second time
deps:
	@sh tests/deps.sh

#: demo          run the main scene: out/demo/report.html, stats.csv, frames/*.png
demo: $(BUILD)/tss
	OMP_WAIT_POLICY=$${OMP_WAIT_POLICY:-passive} $(BUILD)/tss run examples/scenes/demo.json -o $(OUT)/demo --frames png
	@echo "open $(OUT)/demo/report.html"

#: report        error against run time, stability, leaving out: out/report/*.html (under 30 minutes)
report: $(BUILD)/tss $(BUILD)/report
	@sh bench/report.sh -b $(BUILD) -o $(OUT)/report
	@echo "open $(OUT)/report/index.html"

#: examples      build every example
examples: $(BUILD)/01_hello $(BUILD)/tss

#: run-examples  run them and check the number each is known by
run-examples: examples
	@sh tests/run_examples.sh $(BUILD)

$(BUILD)/%: examples/%.c $(HEADERS) $(VIEWERS) tests/checker.h
	@mkdir -p $(BUILD)
	$(CC) $(ALL) $< -o $@ $(if $(filter tss,$*),-lcjson -lpng) $(LIBS)

$(BUILD)/report: bench/report.c $(VIEWERS)
	@mkdir -p $(BUILD)
	$(CC) $(ALL) $< -o $@ -lm

$(BUILD)/test_report: bench/report.c

$(BUILD)/test_%: tests/test_%.c $(HEADERS) $(VIEWERS) $(wildcard tests/*.h)
	@mkdir -p $(BUILD)
	$(CC) $(subst $(CFLAGS),$(TEST_CFLAGS),$(ALL)) $< -o $@ -lcmocka -lcjson -lpng $(LIBS) -lpthread

$(BUILD)/contact_reference $(BUILD)/ccd_queries: $(BUILD)/%: tests/%.c $(HEADERS)
	@mkdir -p $(BUILD)
	$(CC) $(ALL) $< -o $@ $(LIBS)

$(BUILD)/bench_%: bench/bench_%.c $(HEADERS)
	@mkdir -p $(BUILD)
	$(CC) $(ALL) $< -o $@ $(LIBS)

TESTS := $(patsubst tests/%.c,$(BUILD)/%,$(wildcard tests/test_*.c))

#: test          every test in every configuration; ends with `N passed, N failed`
test:
	@$(MAKE) -s -j$(JOBS) PARALLEL=1 test-programs
	@sh tests/run.sh $(BUILD)

test-programs: $(TESTS) $(BUILD)/contact_reference $(BUILD)/ccd_queries examples

#: sanitize      the tests under ASan+UBSan, and under TSan with a pthread pool
#: nodeps        the tests with each TSS_NO_* alone and with all of them
#: compat        gcc, clang, g++, two translation units, the headers alone
#: fuzz          60 s for each fuzz target (clang)
sanitize nodeps compat fuzz:
	@sh tests/run.sh $(BUILD) $@

#: bench         speed against peers and reference figures → out/bench/*.csv (minutes)
bench:
	@sh bench/run.sh $(BUILD) $(OUT)/bench

#: bench-error   error against run time at 50,000 tets and more → bench/results (two minutes a scene, one far more; goes on where it stopped)
bench-error: $(BUILD)/tss
	@sh bench/error.sh -b $(BUILD) large $(OUT)/bench-error
	@mkdir -p bench/results
	@cp $(OUT)/bench-error/error_vs_time.csv $(OUT)/bench-error/error_steps.csv bench/results/

clean:
	rm -rf $(BUILD) $(OUT)
