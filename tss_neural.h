/* tss_neural.h: neural subspaces with Lipschitz optimisation, for tss.h, after paper B
 * (Lyu et al. 2024, "Accelerate Neural Subspace-Based Reduced-Order Solver of Deformable Simulation
 * by Lipschitz Optimization")
 *
 * What it is: a decoder f(z), a small network, maps r numbers to the positions of a mesh. It is
 * trained so that what it can reach is what the body does (Eq. 3 or 4), and so that the elastic
 * energy P(f(z)) has a Hessian that changes slowly with z (Eq. 9, 10): solvers then need fewer
 * iterations. Everything runs in C, in double precision, without automatic differentiation:
 * derivatives are jets (below), third derivatives of the energy included.
 *
 *     #define TSS_IMPLEMENTATION            // in one .c or .cpp file
 *     #include "tss.h"
 *     #include "tss_neural.h"
 *
 *     int width[4] = {8, 64, 64, free_coordinates};
 *     tss_net_def nd = tss_net_def_default();
 *     nd.layers = 3, nd.width = width, nd.outputs = coordinates;
 *     nd.out_base = X, nd.out_index = free;
 *     tss_model m = {0};
 *     tss_net_create(NULL, &nd, &m.decoder);
 *     tss_training_def td = tss_training_def_default();   // unsupervised: Eq. 4, then Eq. 10
 *     td.model = &m, td.elements = elements, td.mass = mass, td.lipschitz_weight = 1e-3;
 *     tss_training *t;
 *     tss_training_create(NULL, &td, &t);
 *     for (int k = 0; k < 100000; k++) tss_training_step(t, NULL);
 *     tss_model_write(NULL, &m, "bar.tssn");
 *
 * tss_cubature_select (Eq. 11) finds few cells that stand for all of them in training; tss_reduced
 * (Eq. 2) simulates with a trained decoder, with scripted handles and contact against a signed
 * distance, by the paper's L-BFGS, projected Newton, or a BFGS that remembers (the default);
 * tss_decoder_basis makes it a basis of the adaptive simulator (tss_subspace.h).
 *
 * Jets: for directions D_a, a < k, and one symmetric matrix C (k × k) a pass carries
 *     y,   y_a = ∂_a y,   y_2 = Σ_ab C_ab ∂_a ∂_b y
 * through the network and the elements. k = 1, C = 1 is a second directional derivative; k = 2 and
 * C = [0 ½; ½ 0] is uᵀ∇²v; k = r, C = G is ⟨G, ∇²⟩ in r + 2 columns. One reverse pass gives the
 * gradient of any α P + Σ β_a P_a + γ P_2 in θ and z. So the exact loss of order 2 costs O(r)
 * columns a sample, its randomised estimators O(1).
 *
 * Memory: a net keeps its parameters and fixed matrices; tss_work grows to the largest batch and
 * holds up to 8 gradients. Threads: a batch is cut into at most 8 fixed chunks, so no more than 8
 * threads help; a net may be read by several threads, each with its own tss_work.
 * Determinism: the same bits for any number of threads; random numbers are tss_rng's alone.
 * Errors: as in tss.h. License: MIT (at the end). No options of its own.
 *
 * CONVENTIONS
 *     Batches are rows: batch × width, row-major. θ: for each layer W (inputs × outputs, row-major:
 *     W[i·outputs + o]), then b (outputs). y = activation(x W + b), the last layer without σ.
 *     x: coordinates, node by node, as in tss.h. r: inputs of the decoder. Gradients are *added* to
 *     arrays named ..._bar, other outputs are overwritten. Symbols are paper B's: z, f, g, P, L_C,
 *     L_LS, λ, σ, M (a mass for each coordinate). Limits: k <= 32768 directions, batch·(k + 2) <
 *     2^31 (an exact Hessian has k = r), else BAD_ARGUMENT.
 */
#ifndef TSS_NEURAL_H
#define TSS_NEURAL_H

#ifndef TSS_H
#error "include tss.h before tss_neural.h"
#endif

#ifdef __cplusplus
extern "C" {
#endif

// ---------------------------------------------------------------------------------------------
// >>random (public)
// xoshiro256++ (Blackman and Vigna), seeded through splitmix64. The state is four numbers and goes
// into model files.
// ---------------------------------------------------------------------------------------------

typedef struct tss_rng {
    uint64_t s[4];
} tss_rng;
TSS_API tss_rng tss_rng_seed(uint64_t seed);
TSS_API uint64_t tss_rng_next(tss_rng *r);
TSS_API double tss_rng_uniform(tss_rng *r);  // in [0, 1), 53 bits
TSS_API double tss_rng_normal(tss_rng *r);   // N(0, 1), Box and Muller; two uniforms each

// ---------------------------------------------------------------------------------------------
// >>networks (public)
// Multi-layer perceptrons between two optional fixed maps.
// ---------------------------------------------------------------------------------------------

typedef enum tss_activation {
    // s > 0: s, else e^s − 1. C1 only: the second derivative jumps from 1 to 0 at 0, where it is
    // taken to be 1 (the left limit, as in JAX).
    TSS_ELU = 0,
    TSS_SILU,      // s / (1 + e^−s), smooth
    TSS_SOFTPLUS,  // ln(1 + e^s), smooth
    TSS_GELU,      // s Φ(s) with the normal distribution itself (erf), smooth
    TSS_ACTIVATIONS
} tss_activation;

typedef struct tss_net_def {
    int layers;        // linear layers, 1..64
    const int *width;  // layers + 1 numbers >= 1: inputs of the MLP, hidden, outputs of the MLP
    tss_activation activation;  // between layers; default TSS_ELU
    uint64_t seed;              // of θ: uniform in ±1/√inputs for W and b of a layer; default 0
    // Encoder's first map: mlp(Aᵀ(x − x0)). in_matrix A: inputs × width[0], row-major; NULL
    // (default): the input is the MLP's. in_base x0: inputs numbers, NULL: 0.
    int inputs;
    const double *in_base, *in_matrix;
    // Decoder's last map: x0 + B·mlp with out_matrix B (outputs × width[layers], row-major); or, if
    // it is NULL, x0 + s·mlp, output i of the MLP going to coordinate out_index[i] (distinct; NULL:
    // i). out_base x0: outputs numbers, NULL: 0. outputs 0 (default): width[layers], out_index
    // NULL.
    int outputs;
    const double *out_base, *out_matrix;
    const int *out_index;
    double out_scale;  // s, finite; default 1. Not with out_matrix, nor with outputs 0
    int cookie;
} tss_net_def;
TSS_API tss_net_def tss_net_def_default(void);

typedef struct tss_net tss_net;    // opaque; owns copies of everything in its def
typedef struct tss_work tss_work;  // scratch memory, one for each thread that calls

// host (NULL: the C library's memory, OpenMP's threads) is copied. Errors: BAD_ARGUMENT (host's log
// says what), NO_MEMORY; *out is then NULL.
TSS_API tss_result tss_net_create(const tss_host *host, const tss_net_def *def, tss_net **out);
TSS_API void tss_net_destroy(tss_net *net);  // NULL allowed

typedef struct tss_net_info {
    int layers, inputs, outputs;  // of the whole map
    const int *width;             // layers + 1
    tss_activation activation;
    size_t parameters;  // of θ
    double out_scale;
} tss_net_info;
TSS_API void tss_net_get_info(const tss_net *net, tss_net_info *out);
// θ, to read and to write; layout under CONVENTIONS. Owned by the net.
TSS_API double *tss_net_parameters(tss_net *net);
TSS_API void tss_net_set_scale(tss_net *net, double s);  // out_scale, where there is one

// Threads are the host's of tss_work. Errors: NO_MEMORY.
TSS_API tss_result tss_work_create(const tss_host *host, tss_work **out);
TSS_API void tss_work_destroy(tss_work *work);  // NULL allowed

// out = net(in), in: batch × inputs, out: batch × outputs. Errors: BAD_ARGUMENT, NO_MEMORY. Cost:
// 2·batch·parameters flops, and the maps.
TSS_API tss_result tss_net_forward(const tss_net *net, tss_work *work, int batch, const double *in,
                                   double *out);
// The reverse pass (runs the forward pass first): with out_bar = ∂S/∂out, batch × outputs, adds
// ∂S/∂θ to theta_bar and ∂S/∂in to in_bar (batch × inputs). Each of these may be NULL.
TSS_API tss_result tss_net_backward(const tss_net *net, tss_work *work, int batch, const double *in,
                                    const double *out_bar, double *theta_bar, double *in_bar);
// Jets of a net without in_matrix: D batch × k × inputs; C batch × k × k, symmetric (NULL: x2 is
// not asked for). Writes x (batch × outputs), x1 (batch × k × outputs), x2 (batch × outputs); NULL:
// not wanted. k >= 0.
TSS_API tss_result tss_net_jets(const tss_net *net, tss_work *work, int batch, int k,
                                const double *z, const double *D, const double *C, double *x,
                                double *x1, double *x2);

// ---------------------------------------------------------------------------------------------
// >>neural_elements (public)
// P(x) = Σ_e w_e vol_e Ψ(F_e) over tetrahedra or triangles of a plane (1 m deep, as in tss.h), Ψ
// the stable Neo-Hookean density of Smith, De Goes and Kim 2018 without the logarithm:
//     Ψ = μ/2 ‖F‖² + λ'/2 (J − α)² − rest,  λ' = λ + μ,  α = 1 + μ/λ',
// zero with no stress at rest, linear elasticity with μ and λ for small strain, finite when
// inverted. A polynomial in F: third derivatives are short. tss_neural_density gives a tss.h
// material with it.
// Shells (cloth): the same Ψ in two dimensions of triangles in space, F 3 × 2, J = √det FᵀF, vol =
// area · thickness; and hinges (Grinspun et al. 2003, Discrete Shells)
//     Σ k (θ − θ̄)² 3 ‖ē‖² / Ā,
// θ the angle between the normals of two cells at an edge, θ̄ that of X, ē the edge and Ā the sum of
// both areas at rest. θ is in (−π, π): a hinge must not fold through itself. Half of a hinge
// belongs to either cell: with weights it counts ½ (w_1 + w_2), cells out of the subset with 0.
// ---------------------------------------------------------------------------------------------

typedef struct tss_elements_def {
    int dim;          // 3 (default): tetrahedra; 2: triangles
    int nodes;        // 1..2^28
    const double *X;  // rest positions, nodes × dim, m
    int cells;        // 1..2^27
    const int *cell;  // cells × (dim + 1), positive volume (but see shell)
    double E, nu;     // Pa > 0, −1 < nu < 0.5; defaults 1e5, 0.4
    // Triangles in space: thickness, m, > 0, with dim 3 and cells × 3 nodes of positive area;
    // default 0: none. J is then the ratio of areas and cannot be negative.
    double shell;
    double bending;  // k of a shell's hinges, J (N·m), >= 0; default 0. Edges of at most two cells
    const double *mu, *lambda;  // of each cell, Pa, in place of E and nu; both or NULL
    int count;                  // subset of cells (cubature, Eq. 11); used if subset is not NULL
    const int *subset;          // count cells, each at most once
    const double *weight;       // w_e >= 0 of each cell of the subset, or of each cell; NULL: 1
    int cookie;
} tss_elements_def;
TSS_API tss_elements_def tss_elements_def_default(void);

typedef struct tss_elements tss_elements;  // opaque, read-only: any number of threads
// Everything is copied. Errors: BAD_ARGUMENT, BAD_MESH (volume not positive, node out of range),
// BAD_MATERIAL, NO_MEMORY; host's log says what; *out is then NULL.
TSS_API tss_result tss_elements_create(const tss_host *host, const tss_elements_def *def,
                                       tss_elements **out);
TSS_API void tss_elements_destroy(tss_elements *e);  // NULL allowed
// P at x (nodes × dim); its gradient is added to g (nodes × dim, NULL: not wanted). Serial.
TSS_API double tss_elements_potential(const tss_elements *e, const double *x, double *g);
// Jets at x along x1 (k × nodes·dim) with C (k × k) and x2 (nodes·dim), both NULL: no second order.
// Writes P, P1 (k) and P2; adds to the ..._bar arrays the gradient of alpha P + Σ beta_a P1_a +
// gamma P2 in x, x1 and x2. Any output may be NULL; beta NULL: 0. Serial. Errors: BAD_ARGUMENT,
// NO_MEMORY.
TSS_API tss_result tss_elements_jets(const tss_elements *e, int k, const double *x,
                                     const double *x1, const double *C, const double *x2, double *P,
                                     double *P1, double *P2, double alpha, const double *beta,
                                     double gamma, double *x_bar, double *x1_bar, double *x2_bar);
// A tss_density; user: two doubles, mu and lambda. Set has_C = 1 in the material.
TSS_API void tss_neural_density(void *user, int dim, int count, const int *cell, const double *F,
                                double *psi, double *P, double *C);

// ---------------------------------------------------------------------------------------------
// >>reduced (public)
// P(f(z)) and its derivatives in z. The decoder has no in_matrix and gives the elements'
// coordinates.
// ---------------------------------------------------------------------------------------------

// For each of batch rows of z: P (batch), gradient (batch × r), hessian (batch × r × r, exact, the
// curvature of f included, symmetric to rounding). NULL: not wanted. Cost: O(1) columns, with the
// Hessian 2(r + 1). Errors: BAD_ARGUMENT, NO_MEMORY.
TSS_API tss_result tss_reduced_potential(const tss_net *decoder, const tss_elements *e,
                                         tss_work *work, int batch, const double *z, double *P,
                                         double *gradient, double *hessian);
// The same with coordinates that a script moves (below; NULL: none).
struct tss_held;
TSS_API tss_result tss_reduced_potential_held(const tss_net *decoder, const tss_elements *e,
                                              tss_work *work, const struct tss_held *held,
                                              int batch, const double *z, double *P,
                                              double *gradient, double *hessian);
// u ᵀ∇²_z P v of each row (z, u, v: batch × r), by polarisation of one jet.
TSS_API tss_result tss_reduced_second(const tss_net *decoder, const tss_elements *e, tss_work *work,
                                      int batch, const double *z, const double *u, const double *v,
                                      double *out);

// ---------------------------------------------------------------------------------------------
// >>losses (public)
// Values go to *loss (NULL allowed); weight times the gradient is added to the ..._bar arrays (each
// may be NULL). Errors: BAD_ARGUMENT, NO_MEMORY.
// ---------------------------------------------------------------------------------------------

// Eq. (3): mean over the batch of ‖f(g(x)) − x‖²_M. x: batch × coordinates; mass: one for each
// coordinate, NULL: 1. The encoder's outputs are the decoder's inputs.
TSS_API tss_result tss_loss_reconstruction(const tss_net *decoder, const tss_net *encoder,
                                           tss_work *work, const double *mass, int batch,
                                           const double *x, double weight, double *loss,
                                           double *decoder_bar, double *encoder_bar);

// Eq. (4): mean P(f(z_i)) + lambda · mean over i ≠ j of ¼ ln²((‖f_i − f_j‖²_M + eps) /
// (sigma² ‖z_i − z_j‖² + eps)), which is ln²(‖Δf‖_M / (σ‖Δz‖)) for eps = 0. sigma > 0, eps >= 0,
// batch >= 2. parts (NULL, or 2 numbers): the mean potential; the mean repulsion without lambda.
TSS_API tss_result tss_loss_unsupervised(const tss_net *decoder, const tss_elements *e,
                                         tss_work *work, const double *mass, double lambda,
                                         double sigma, double eps, int batch, const double *z,
                                         double weight, double *loss, double *parts,
                                         double *decoder_bar);

typedef enum tss_estimator {
    TSS_LIPSCHITZ_EXACT = 0,
    TSS_LIPSCHITZ_UV,  // order 2: (uᵀ ΔH v)², u and v independent N(0, 1): mean ‖ΔH‖²_F
    TSS_LIPSCHITZ_U,   // order 2: ‖ΔH u‖², u ~ N(0, 1): the same mean, far less variance
} tss_estimator;

// Coordinates that a script moves (tss_reduced_set_handles): in P they are where the script says,
// not where the decoder does. They do not depend on z, and no adjoint of theirs reaches the
// decoder.
typedef struct tss_held {
    int count;            // 0: none
    const int *index;     // coordinates, each once
    const double *value;  // samples × count
} tss_held;

typedef struct tss_lipschitz_def {
    int order;                // o of Eq. (12): 0: P, 1: ∇P, 2 (default): ∇²P, Eq. (9)
    tss_estimator estimator;  // default EXACT; the others for order 2 only
    int probes;               // of the estimators, averaged, 1..r; default 1
    double floor;   // ‖Δz‖² is replaced by max(‖Δz‖², floor), >= 0; default 1e-12
    int undivided;  // 1: without the division by ‖Δz‖² (the spread of H alone); default 0
    const tss_held *held;  // a value for each sample of the batch; borrowed; NULL (default): none
} tss_lipschitz_def;
TSS_API tss_lipschitz_def tss_lipschitz_def_default(void);

// Eq. (9) and (12): mean over all i ≠ j of the batch of ‖∂ᵒP(z_i) − ∂ᵒP(z_j)‖² / ‖z_i − z_j‖²,
// Frobenius norm. probe: probes × 2 × r numbers u, v (v unused by U), shared by the batch; NULL for
// EXACT. z_bar (batch × r): the gradient in z, for samples that come from an encoder.
TSS_API tss_result tss_loss_lipschitz(const tss_net *decoder, const tss_elements *e, tss_work *work,
                                      const tss_lipschitz_def *def, int batch, const double *z,
                                      const double *probe, double weight, double *loss,
                                      double *decoder_bar, double *z_bar);
// Eq. (7): the largest ratio over the pairs of the batch (pairs at distance 0 are left out), exact,
// Frobenius norm. order 0, 1 or 2; batch >= 2.
TSS_API tss_result tss_lipschitz_estimate(const tss_net *decoder, const tss_elements *e,
                                          tss_work *work, int order, int batch, const double *z,
                                          double *out);
// The same with coordinates that a script moves (NULL: none).
TSS_API tss_result tss_lipschitz_estimate_held(const tss_net *decoder, const tss_elements *e,
                                               tss_work *work, int order, const tss_held *held,
                                               int batch, const double *z, double *out);

// ---------------------------------------------------------------------------------------------
// >>cubature (public)
// Which cells, with which weights, stand for all of them (Eq. 11): Σ w_e g_e(z_t) ≈ Σ g_e(z_t), g_e
// the reduced gradient of one cell. Greedy non-negative least squares (An, Kim, James 2008, with
// Lawson and Hanson's active set): the cell that points most along what is missing is added, all
// weights are solved for again, cells whose weight would be negative leave.
// ---------------------------------------------------------------------------------------------

typedef struct tss_cubature_def {
    int count;       // most cells, >= 1; default 300
    int candidates;  // cells to choose from, drawn by seed; 0 (default): all. Memory: candidates ×
                     // samples × r doubles
    double tol;      // relative error at which to stop, >= 0; default 0
    uint64_t seed;
    const tss_held *held;  // a value for each sample; borrowed; NULL (default): none
} tss_cubature_def;
TSS_API tss_cubature_def tss_cubature_def_default(void);
// z: samples × r, of the initial subspace; each counts alike (its equations are divided by the norm
// of its gradient). subset and weight: room for def.count; ascending cells of e and w_e > 0, ready
// for tss_elements_def. *count: cells chosen; *error (NULL allowed): ‖Σ w_e g_e − g‖ / ‖g‖ over the
// samples. Cost: chosen · candidates · samples · r, and as much as memory. Errors: BAD_ARGUMENT
// (a gradient that is not finite, too), NO_MEMORY.
TSS_API tss_result tss_cubature_select(const tss_net *decoder, const tss_elements *e,
                                       tss_work *work, const tss_cubature_def *def, int samples,
                                       const double *z, int *subset, double *weight, int *count,
                                       double *error);

// ---------------------------------------------------------------------------------------------
// >>adam (public)
// Kingma and Ba 2015, with bias correction. Step t (from 0) uses the rate
//     rate · decay^floor(t / decay_every) · min(1, (t + 1) / warmup).
// ---------------------------------------------------------------------------------------------

typedef struct tss_adam_def {
    double rate;           // > 0; default 1e-3
    double beta1, beta2;   // in [0, 1); defaults 0.9, 0.999
    double eps;            // > 0; default 1e-8
    double decay;          // > 0; default 1
    uint64_t decay_every;  // steps; 0 (default): no decay
    uint64_t warmup;       // steps; default 0
} tss_adam_def;
TSS_API tss_adam_def tss_adam_def_default(void);

typedef struct tss_adam tss_adam;  // opaque: moments, step count and def
// Errors: BAD_ARGUMENT, NO_MEMORY.
TSS_API tss_result tss_adam_create(const tss_host *host, const tss_adam_def *def, size_t parameters,
                                   tss_adam **out);
TSS_API void tss_adam_destroy(tss_adam *a);  // NULL allowed
// Moves parameters [first, first + count) along their gradient with the rate of the current step;
// tss_adam_advance then makes it the next. A network each: two calls, one advance.
TSS_API void tss_adam_update(tss_adam *a, size_t first, size_t count, double *theta,
                             const double *g);
TSS_API void tss_adam_advance(tss_adam *a);
TSS_API uint64_t tss_adam_steps(const tss_adam *a);
TSS_API double tss_adam_rate(const tss_adam *a);  // of the current step
// Changes rates between steps (a second phase); moments and steps stay, unless restart.
TSS_API tss_result tss_adam_set(tss_adam *a, const tss_adam_def *def, int restart);

// ---------------------------------------------------------------------------------------------
// >>models (public)
// What a file holds: a decoder, and what training needs to go on in the very bits of an
// uninterrupted run. The format is documented in docs/neural.md: little-endian, magic, version,
// size, checksum.
// ---------------------------------------------------------------------------------------------

typedef struct tss_model {  // start from zeros
    tss_net *decoder;
    tss_net *encoder;  // NULL: unsupervised
    tss_adam *adam;    // NULL: trained
    tss_rng rng;       // of the training samples
    uint64_t step;     // training steps taken
} tss_model;
TSS_API void tss_model_free(tss_model *m);  // destroys the parts, leaves zeros

// Other coordinates of the same manifold, z = T y (T: r × r, row-major): the decoder becomes
// y → f(T y), the encoder x → T⁻¹ g(x), by their first and last layer. The decoder has no
// in_matrix, the encoder no last map. What the optimiser remembers is of the old coordinates: start
// it anew. Errors: BAD_ARGUMENT (T is singular or not finite), NO_MEMORY; nothing changes then.
TSS_API tss_result tss_model_change_z(tss_model *m, const double *T);

// Bytes that the model takes; written to data if size suffices (data NULL: the size only; 0: size
// too small, no decoder, or a number that is not finite: no reader would take it).
TSS_API size_t tss_model_save(const tss_model *m, void *data, size_t size);
// *out is overwritten; on an error zeros, and why (NULL allowed, why_size bytes) says what is
// wrong. Nothing is believed: sizes are checked against the bytes there are before memory is taken.
// Errors: FORMAT, NO_MEMORY.
TSS_API tss_result tss_model_load(const tss_host *host, const void *data, size_t size,
                                  tss_model *out, char *why, size_t why_size);
// The same through files; also FILE. A file is written beside the old one first, then renamed.
TSS_API tss_result tss_model_write(const tss_host *host, const tss_model *m, const char *path);
TSS_API tss_result tss_model_read(const tss_host *host, const char *path, tss_model *out, char *why,
                                  size_t why_size);

// ---------------------------------------------------------------------------------------------
// >>training (public)
// Eq. (10): L_C + λ_LS L_LS, from step lipschitz_from on. 0: joint training from the start; later:
// vanilla first. With a given def the next step depends on the model alone (bits included): save
// between any two steps, load, go on.
// ---------------------------------------------------------------------------------------------

typedef struct tss_training_def {
    tss_model *model;              // borrowed; adam is made from the def below if it has none
    const tss_elements *elements;  // P of Eq. (4); borrowed. Supervised: NULL allowed
    const tss_elements *cubature;  // P of L_LS; NULL (default): elements
    const double *mass;            // of each coordinate, borrowed; NULL: 1
    const double *frames;  // supervised (there is an encoder): frame_count × coordinates, borrowed
    int frame_count;
    int batch;             // default 32
    double lambda, sigma;  // Eq. (4), unsupervised; defaults 1, 1
    double eps;            // of the logarithm; default 1e-8
    uint64_t ramp;  // unsupervised: steps over which out_scale grows from 0 to 1, and sigma from 0
                    // to itself; default 0: none
    // Unsupervised: r × r, samples are z = S n with n ~ N(0, 1), and Eq. (4) compares ‖Δf‖ with
    // σ‖Δn‖: L_C of a model after tss_model_change_z(T) is with S = T⁻¹ what it was. Borrowed;
    // NULL (default): 1
    const double *spread;
    double lipschitz_weight;      // λ_LS; default 0: vanilla
    uint64_t lipschitz_from;      // first step with L_LS; default 0
    int lipschitz_batch;          // samples of L_LS, >= 2; default 16
    tss_lipschitz_def lipschitz;  // its held is not used: supervised, the coordinates below are
                                  // where the frame has them in L_LS
    int held_count;               // default 0
    const int *held;              // coordinates, each once; borrowed
    int through_encoder;  // supervised: L_LS also moves the encoder through z = g(x); default 1
    tss_adam_def adam;
    int cookie;
} tss_training_def;
TSS_API tss_training_def tss_training_def_default(void);

typedef struct tss_training_info {
    double loss;       // L_C of the batch
    double parts[2];   // unsupervised: potential, repulsion
    double lipschitz;  // L_LS of the batch (its estimate), 0 before it is on
    double rate;
    int skipped;  // 1: the gradient or its square was not finite, and θ stays as it was
} tss_training_info;

typedef struct tss_training tss_training;  // opaque: scratch; the state is the model's
// Errors: BAD_ARGUMENT (the log says what), NO_MEMORY; *out is then NULL.
TSS_API tss_result tss_training_create(const tss_host *host, const tss_training_def *def,
                                       tss_training **out);
TSS_API void tss_training_destroy(tss_training *t);  // NULL allowed; the model stays
// One step of Adam; info may be NULL. Errors: NO_MEMORY.
TSS_API tss_result tss_training_step(tss_training *t, tss_training_info *info);

// ---------------------------------------------------------------------------------------------
// >>reduced_solver (public)
// Eq. (2): each step finds z that minimises
//     E(z) = ‖f(z) − q̄‖²_M / (2h²) + P(f(z)) + C(f(z)) − force·f(z),   q̄ = 2 x_t − x_{t−1},
// or, when h = 0 (quasi-static), the same without the first term. C is a penalty against a signed
// distance φ (§5.2):
//     C(x) = ½ k Σ_i a_i min(0, φ(x_i) − margin)².
// f is affine in its last hidden layer: the first and last terms cost what a layer costs, and with
// a cubature (elements of a subset) and a list of contact nodes a step does not depend on the size
// of the mesh.
// ---------------------------------------------------------------------------------------------

typedef enum tss_exit {    // the paper's four (§5)
    TSS_EXIT_CONVERGED,    // ‖∇E‖∞ <= eps; BFGS: f would move by no more than tol
    TSS_EXIT_SADDLE,       // E fell by less than ftol |E|
    TSS_EXIT_LINE_SEARCH,  // max_line trials without enough decrease
    TSS_EXIT_ITERATIONS,   // max_iterations
    TSS_EXITS
} tss_exit;

typedef enum tss_reduced_method {
    // Quasi-Newton with an inverse Hessian that stays from step to step, since E's Hessian changes
    // little between them. It begins with the exact one, and again after tss_reduced_set and
    // _project, when other nodes become handles, and, if h = 0, when other nodes touch. Its exit is
    // measured in f, so that the unit of z does not matter. r <= 1024. Masses not all 0.
    TSS_BFGS,
    TSS_LBFGS,  // the paper's: it begins each step anew, with −∇E
    // The exact Hessian of E in z (the curvature of f included; of C without ∇²φ), its negative
    // eigenvalues put to 0, and `shift` added to all. r <= 1024; costs r + 1 columns an iteration.
    TSS_PROJECTED_NEWTON,
} tss_reduced_method;

typedef struct tss_reduced_def {
    // Its last layers and maps are copied; the layers before are borrowed. Neither may change.
    const tss_net *decoder;
    const tss_elements *elements;  // all, or a cubature; borrowed
    const double *mass;            // of each coordinate, kg, copied; required when h > 0; NULL: 1
    const double *start;           // r numbers; NULL: 0
    double h;                      // s; 0: quasi-static. Default 0.05
    tss_reduced_method solver;     // default TSS_BFGS
    // BFGS: a step ends when two directions in a row would move f by no more than tol of the size
    // of f(start), both in ‖·‖_M (a root mean square). >= 0 (below 1e-14: 1e-14); default 1e-4.
    double tol;
    double eps;   // the others: J per unit of z, >= 0; default 1e-5
    double ftol;  // the others: >= 0; default 2.2e-9 (L-BFGS-B's, as the paper's code); 0: never
    int memory;   // LBFGS: pairs, 1..64; default 10
    int max_line, max_iterations;  // defaults 128, 1024
    double shift;  // PROJECTED_NEWTON: > 0, J per unit of z², absolute as in the paper's code (so
                   // it depends on the scale of z and of the energy); default 1e-6
    // Signed distance at x (dim numbers), m, negative inside; writes its gradient, of length 1, to
    // n (dim). NULL (default): no contact. Called in every evaluation, from the thread that steps.
    // An obstacle moves if what sdf_user points to is changed between steps.
    double (*sdf)(void *user, const double *x, double *n);
    void *sdf_user;
    double contact_stiffness;  // k >= 0; N/m if a is a number, N/m³ for an area, 1/s² for a mass;
                               // default 0
    double contact_margin;     // m; default 0
    int contact_count;         // nodes that are tested; used if contact_node is not NULL
    const int *contact_node;   // each at most once; copied. NULL (default): every node
    const double *contact_weight;  // a_i >= 0 of each of them, copied; NULL: 1
    int cookie;
} tss_reduced_def;
TSS_API tss_reduced_def tss_reduced_def_default(void);

typedef struct tss_reduced_info {
    tss_exit exit;
    int iterations, evaluations;  // of E with its gradient
    double energy, gradient;      // E and ‖∇E‖∞ at the end
    int hessians;                 // that were computed, not of LBFGS
} tss_reduced_info;

typedef struct tss_reduced tss_reduced;  // opaque; one thread at a time, tss_reduced_x included
// Memory: 2 copies of the last layer (coordinates × width), the second only of the rows that
// elements and contact touch; but for L-BFGS 2 r numbers more for each of these rows. Errors:
// BAD_ARGUMENT (the log says what), NO_MEMORY; *out is then NULL.
TSS_API tss_result tss_reduced_create(const tss_host *host, const tss_reduced_def *def,
                                      tss_reduced **out);
TSS_API void tss_reduced_destroy(tss_reduced *s);  // NULL allowed
// One step; starts from z_t, or from 2 z_t − z_{t−1} where E is lower. Allocates nothing. info may
// be NULL. Errors: none; how it ended is info.exit, and the state is the best that was found.
TSS_API tss_result tss_reduced_step(tss_reduced *s, tss_reduced_info *info);
// At rest in f(z), handles where they are. Errors: BAD_STATE (not finite), the state is as before.
TSS_API tss_result tss_reduced_set(tss_reduced *s, const double *z);
// At rest in the f(z) that minimises ½‖f(z) − x‖²_M (without handles), from the current z, by
// projected Newton (L-BFGS if r > 1024). x: coordinates, m. info (NULL allowed): energy is that
// minimum, gradient of it; CONVERGED: the next iteration would move f by less than 1e-10 of the
// size of x, both in ‖·‖_M. Not counted in tss_reduced_exits. Allocates nothing. Errors:
// BAD_ARGUMENT (x is not finite), the state is as before.
TSS_API tss_result tss_reduced_project(tss_reduced *s, const double *x, tss_reduced_info *info);
// Scripted nodes: in the steps to come node[k] is at x[k] (count × dim, m) and not where f(z) puts
// it, until changed; count 0: none. What they do to E does not move z but through the elements
// they share with other nodes. Copied; allocates nothing; cheaper if the nodes stay the same.
// Errors: BAD_ARGUMENT (node out of range or twice, not finite; the log says what), nothing changes
// then.
TSS_API tss_result tss_reduced_set_handles(tss_reduced *s, int count, const int *node,
                                           const double *x);
// Force on each coordinate, N, until changed; copied. NULL: none.
TSS_API void tss_reduced_set_force(tss_reduced *s, const double *force);
TSS_API const double *tss_reduced_z(const tss_reduced *s);  // r
// Coordinates: f(z), handles where they are. Decoded by the first call after a step.
TSS_API const double *tss_reduced_x(const tss_reduced *s);
TSS_API const uint64_t *tss_reduced_exits(
    const tss_reduced *s);  // TSS_EXITS counts since the start

// Signed distances for tss_reduced_def.sdf; user points to the struct.
typedef struct tss_ball {  // φ = ‖x − center‖ − radius
    int dim;
    double center[3], radius;  // m
} tss_ball;
typedef struct tss_halfspace {  // φ = normal·(x − point): what lies against the normal is inside
    int dim;
    double point[3], normal[3];  // m; of length 1
} tss_halfspace;
TSS_API double tss_sdf_ball(void *ball, const double *x, double *n);
TSS_API double tss_sdf_halfspace(void *halfspace, const double *x, double *n);

// ---------------------------------------------------------------------------------------------
// >>decoder_basis (public)
// A decoder as a basis of the adaptive simulator (tss_subspace.h, tss_basis_custom): its tangent
// ∂f/∂z at the z whose f(z) is nearest to the body, anew in every step,
//     tss_decoder_basis *b;
//     tss_decoder_basis_create(NULL, 3, decoder, NULL, mass, NULL, &b);
//     tss_basis_def d = tss_basis_custom(r, NULL, tss_decoder_basis_refresh, b);
//     tss_basis_add(world, body, &d, NULL);
// which the oracle then enriches with nodes where it does not suffice.
// ---------------------------------------------------------------------------------------------

typedef struct tss_decoder_basis tss_decoder_basis;  // opaque; one body, as long as its world
// The decoder (no in_matrix, r <= 1024 inputs) gives the coordinates of all nodes of the body in
// its order; both nets are borrowed and must not change. encoder (NULL allowed): z is looked for
// from g(x), and depends on x alone; without one from the last z, so that a run that is resumed
// must put it back with tss_decoder_basis_set. mass: of each coordinate, copied; NULL: 1. z: where
// it starts, NULL: 0. Errors: BAD_ARGUMENT (the log says what), NO_MEMORY; *out is then NULL.
TSS_API tss_result tss_decoder_basis_create(const tss_host *host, int dim, const tss_net *decoder,
                                            const tss_net *encoder, const double *mass,
                                            const double *z, tss_decoder_basis **out);
TSS_API void tss_decoder_basis_destroy(tss_decoder_basis *b);  // NULL allowed
// For tss_basis_custom, with b as user. Column a is the part of ∂f/∂z_a that is orthogonal in M to
// those before it, of unit norm: the same span, well conditioned (0 where there is no such part).
// A body of another number of nodes: columns of 0, and an error in the log. Allocates nothing.
TSS_API void tss_decoder_basis_refresh(void *b, const tss_ctx *c, int first_node, int nodes,
                                       double *columns);
TSS_API const double *tss_decoder_basis_z(const tss_decoder_basis *b);  // r, of the last refresh
TSS_API tss_result tss_decoder_basis_set(tss_decoder_basis *b, const double *z);  // or BAD_STATE

#ifdef __cplusplus
}
#endif
#endif  // TSS_NEURAL_H

#if defined(TSS_IMPLEMENTATION) && !defined(TSS_NEURAL_IMPLEMENTATION_DONE)
#define TSS_NEURAL_IMPLEMENTATION_DONE

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined(__clang__)
#pragma clang fp contract(off)
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("fp-contract=off")
#endif

#ifdef __cplusplus
extern "C" {
#endif

// ---------------------------------------------------------------------------------------------
// >>random (private)
// ---------------------------------------------------------------------------------------------

tss_rng tss_rng_seed(uint64_t seed) {
    tss_rng r;
    for (int k = 0; k < 4; k++) {  // splitmix64
        uint64_t z = seed += 0x9E3779B97F4A7C15u;
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
        r.s[k] = z ^ (z >> 31);
    }
    return r;
}

static uint64_t tss__n_rotate(uint64_t x, int k) { return x << k | x >> (64 - k); }

uint64_t tss_rng_next(tss_rng *r) {
    uint64_t *s = r->s, out = tss__n_rotate(s[0] + s[3], 23) + s[0], t = s[1] << 17;
    s[2] ^= s[0], s[3] ^= s[1], s[1] ^= s[2], s[0] ^= s[3], s[2] ^= t;
    s[3] = tss__n_rotate(s[3], 45);
    return out;
}

double tss_rng_uniform(tss_rng *r) { return (double)(tss_rng_next(r) >> 11) / 9007199254740992.0; }

double tss_rng_normal(tss_rng *r) {
    double u = 1 - tss_rng_uniform(r), v = tss_rng_uniform(r);  // u in (0, 1]
    return sqrt(-2 * log(u)) * cos(6.28318530717958647692 * v);
}

// ---------------------------------------------------------------------------------------------
// >>slabs (private)
// Scratch memory is planned twice by the same code: once to count, once to hand out.
// ---------------------------------------------------------------------------------------------

typedef struct tss__n_slab {
    double *base;  // NULL: counting
    size_t used;   // doubles
    double want;   // the same, and cannot overflow
} tss__n_slab;

static double *tss__n_take(tss__n_slab *s, double rows, size_t width) {
    double count = rows * (double)width + 8;
    double *at = s->base ? s->base + s->used : NULL;
    s->want += count;
    if (s->want < 1e15) s->used += ((size_t)count + 7) & ~(size_t)7;
    return at;
}

struct tss_work {
    tss_host host;
    double *p;
    size_t bytes;
};

tss_result tss_work_create(const tss_host *host, tss_work **out) {
    tss_host h = host ? *host : tss_host_default();
    *out = NULL;
    tss_work *w = (tss_work *)tss_alloc(&h, sizeof *w);
    if (!w) return TSS_ERROR_NO_MEMORY;
    w->host = h, w->p = NULL, w->bytes = 0;
    *out = w;
    return TSS_OK;
}

void tss_work_destroy(tss_work *w) {
    if (!w) return;
    tss_host h = w->host;
    tss_free(&h, w->p, w->bytes);
    tss_free(&h, w, sizeof *w);
}

// Makes room for what s counted and turns it to handing out. 0: no memory.
static int tss__n_room(tss_work *w, tss__n_slab *s) {
    if (s->want >= 1e15) return 0;
    size_t bytes = s->used * sizeof(double);
    if (bytes > w->bytes) {
        tss_free(&w->host, w->p, w->bytes);
        w->bytes = 0;
        w->p = (double *)tss_alloc(&w->host, bytes);
        if (!w->p) return 0;
        w->bytes = bytes;
    }
    s->base = w->p, s->used = 0, s->want = 0;
    return 1;
}

static void tss__n_zero(double *p, size_t count) {
    for (size_t i = 0; i < count; i++) p[i] = 0;
}

// ---------------------------------------------------------------------------------------------
// >>products (private)
// C += A B by tiles of 4 × 8 sums held in registers; eight columns of B are copied into a panel
// first, so that transposes and gathered rows or columns cost the same. Sums run over the inner
// index in order: the bits do not depend on the size of the batch.
// ---------------------------------------------------------------------------------------------

typedef struct tss__n_view {  // element (i, j): p[(ri ? ri[i] : i)·rs + (ci ? ci[j] : j)·cs]
    const double *p;
    size_t rs, cs;
    const int *ri, *ci;
} tss__n_view;

static tss__n_view tss__n_rows(const double *p, size_t width) {
    tss__n_view v = {p, width, 1, NULL, NULL};
    return v;
}

static tss__n_view tss__n_turned(tss__n_view a) {
    tss__n_view v = {a.p, a.cs, a.rs, a.ci, a.ri};
    return v;
}

static void tss__n_panel(size_t k, size_t from, size_t columns, const tss__n_view *b, double *to) {
    for (size_t p = 0; p < k; p++) {
        const double *row = b->p + (b->ri ? (size_t)b->ri[p] : p) * b->rs;
        for (size_t c = 0; c < 8; c++)
            to[8 * p + c] =
                c < columns ? row[(b->ci ? (size_t)b->ci[from + c] : from + c) * b->cs] : 0;
    }
}

// m <= 4 rows of A (element (i, p) at A[i·rs + p·cs]) times the panel.
static void tss__n_tile4(size_t k, const double *A, size_t rs, size_t cs, const double *panel,
                         double acc[4][8]) {
    for (size_t p = 0; p < k; p++)
        for (int i = 0; i < 4; i++) {
            double a = A[(size_t)i * rs + p * cs];
            for (int c = 0; c < 8; c++) acc[i][c] += a * panel[8 * p + (size_t)c];
        }
}

static void tss__n_tile1(size_t k, const double *A, size_t cs, const double *panel, double acc[8]) {
    for (size_t p = 0; p < k; p++)
        for (int c = 0; c < 8; c++) acc[c] += A[p * cs] * panel[8 * p + (size_t)c];
}

// C (m × n, rows of width ldc) += A (m × k) · B (k × n); panel: 8·k doubles. A has no index lists.
static void tss__n_product(size_t m, size_t n, size_t k, tss__n_view A, tss__n_view B, double *C,
                           size_t ldc, double *panel) {
    for (size_t j = 0; j < n; j += 8) {
        size_t columns = n - j < 8 ? n - j : 8;
        tss__n_panel(k, j, columns, &B, panel);
        for (size_t i = 0; i < m; i += 4) {
            size_t rows = m - i < 4 ? m - i : 4;
            double acc[4][8] = {{0}};
            if (rows == 4)
                tss__n_tile4(k, A.p + i * A.rs, A.rs, A.cs, panel, acc);
            else
                for (size_t r = 0; r < rows; r++)
                    tss__n_tile1(k, A.p + (i + r) * A.rs, A.cs, panel, acc[r]);
            for (size_t r = 0; r < rows; r++)
                for (size_t c = 0; c < columns; c++) C[(i + r) * ldc + j + c] += acc[r][c];
        }
    }
}

// ---------------------------------------------------------------------------------------------
// >>activations (private)
// σ and its first three derivatives: the reverse pass of a second-order jet needs the third.
// ---------------------------------------------------------------------------------------------

static double tss__n_logistic(double s) {  // without overflow on either side
    if (s >= 0) return 1 / (1 + exp(-s));
    double e = exp(s);
    return e / (1 + e);
}

static void tss__n_elu(double s, double d[4]) {
    double e = s > 0 ? 0 : exp(s);
    d[0] = s > 0 ? s : expm1(s), d[1] = s > 0 ? 1 : e, d[2] = e, d[3] = e;
}

static void tss__n_gelu(double s, double d[4]) {
    double cdf = 0.5 * erfc(-s * 0.70710678118654752440);
    double pdf = 0.39894228040143267794 * exp(-0.5 * s * s);
    d[0] = s * cdf, d[1] = cdf + s * pdf, d[2] = (2 - s * s) * pdf, d[3] = (s * s - 4) * s * pdf;
}

static void tss__n_activate(tss_activation a, double s, double d[4]) {
    if (a == TSS_ELU || a == TSS_GELU) {
        a == TSS_ELU ? tss__n_elu(s, d) : tss__n_gelu(s, d);
        return;
    }
    double p = tss__n_logistic(s), q = p * (1 - p), q1 = q * (1 - 2 * p);
    if (a == TSS_SOFTPLUS) {
        d[0] = (s > 0 ? s : 0) + log1p(exp(-fabs(s)));
        d[1] = p, d[2] = q, d[3] = q1;
    } else {
        double q2 = q1 * (1 - 2 * p) - 2 * q * q;
        d[0] = s * p, d[1] = p + s * q, d[2] = 2 * q + s * q1, d[3] = 3 * q1 + s * q2;
    }
}

// ---------------------------------------------------------------------------------------------
// >>networks (private)
// ---------------------------------------------------------------------------------------------

#define TSS__NET_COOKIE 0x6e6574
#define TSS__NET_LAYERS 64
#define TSS__N_CHUNKS \
    8  // pieces of a batch: the most threads that help, and gradients that are held

enum { TSS__MAP_NONE, TSS__MAP_SCATTER, TSS__MAP_MATRIX };

struct tss_net {
    tss_host host;
    int layers, inputs, outputs;
    int width[TSS__NET_LAYERS + 1], widest;
    size_t off[TSS__NET_LAYERS + 2];    // Σ widths before: where a layer lies on a tape, per row
    size_t theta[TSS__NET_LAYERS + 1];  // first parameter of a layer; [layers]: all
    tss_activation activation;
    int has_in, map;
    double scale;
    double *p;  // one block: θ, in_base, in_matrix, out_base, out_matrix
    size_t p_bytes;
    double *par, *in_base, *in_matrix, *out_base, *out_matrix;
    int *from;  // SCATTER: output of the MLP at each coordinate, −1: none
    size_t from_bytes;
};

tss_net_def tss_net_def_default(void) {
    tss_net_def d;
    memset(&d, 0, sizeof d);
    d.out_scale = 1, d.cookie = TSS__NET_COOKIE;
    return d;
}

static tss_result tss__n_refuse(const tss_host *h, tss_result r, const char *text) {
    tss_log(h, TSS_LOG_ERROR, "%s", text);
    return r;
}

// What is wrong with a def; NULL: nothing.
static const char *tss__net_complaint(const tss_net_def *d) {
    if (d->layers < 1 || d->layers > TSS__NET_LAYERS) return "network: layers must be 1..64";
    if (!d->width) return "network: no widths";
    for (int l = 0; l <= d->layers; l++)
        if (d->width[l] < 1 || d->width[l] > (1 << 26))
            return "network: a width is outside 1..2^26";
    if ((unsigned)d->activation >= TSS_ACTIVATIONS) return "network: unknown activation";
    if (d->in_matrix && (d->inputs < 1 || d->inputs > (1 << 28)))
        return "network: inputs must be 1..2^28";
    if (!d->in_matrix && d->in_base) return "network: in_base without in_matrix";
    int last = d->width[d->layers];
    if (d->outputs < 0 || d->outputs > (1 << 28)) return "network: outputs must be 0..2^28";
    if (d->outputs == 0 && (d->out_matrix || d->out_index || d->out_base))
        return "network: an outer layer without outputs";
    if (!isfinite(d->out_scale)) return "network: out_scale is not finite";
    if (d->out_scale != 1 && (d->out_matrix || d->outputs == 0))
        return "network: out_scale needs outputs, and no out_matrix";
    if (d->outputs == 0 || d->out_matrix) return NULL;
    if (!d->out_index && d->outputs != last) return "network: outputs differ from the last width";
    for (int i = 0; d->out_index && i < last; i++)
        if (d->out_index[i] < 0 || d->out_index[i] >= d->outputs)
            return "network: out_index out of range";
    return NULL;
}

static void tss__net_layout(tss_net *n) {
    n->off[0] = n->theta[0] = 0, n->widest = 1;
    for (int l = 0; l <= n->layers; l++) {
        n->off[l + 1] = n->off[l] + (size_t)n->width[l];
        n->widest = n->width[l] > n->widest ? n->width[l] : n->widest;
        if (l < n->layers)
            n->theta[l + 1] = n->theta[l] + ((size_t)n->width[l] + 1) * (size_t)n->width[l + 1];
    }
}

static size_t tss__net_parts(const tss_net *n, size_t part[5]) {
    size_t in = n->has_in ? (size_t)n->inputs : 0, out = n->map ? (size_t)n->outputs : 0;
    part[0] = n->theta[n->layers], part[1] = in, part[2] = in * (size_t)n->width[0];
    part[3] = out, part[4] = n->map == TSS__MAP_MATRIX ? out * (size_t)n->width[n->layers] : 0;
    return part[0] + part[1] + part[2] + part[3] + part[4];
}

// Takes memory for a net whose sizes are set. 0: none.
static int tss__net_arrays(tss_net *n) {
    size_t part[5], all = tss__net_parts(n, part);
    if (n->map == TSS__MAP_SCATTER) {
        n->from_bytes = (size_t)n->outputs * sizeof(int);
        n->from = (int *)tss_alloc(&n->host, n->from_bytes);
        if (!n->from) return 0;
    }
    if (all > (SIZE_MAX >> 5)) return 0;
    n->p_bytes = all * sizeof(double);
    n->p = (double *)tss_alloc(&n->host, n->p_bytes);
    if (!n->p) return 0;
    tss__n_zero(n->p, all);
    n->par = n->p, n->in_base = n->par + part[0], n->in_matrix = n->in_base + part[1];
    n->out_base = n->in_matrix + part[2], n->out_matrix = n->out_base + part[3];
    return 1;
}

void tss_net_destroy(tss_net *n) {
    if (!n) return;
    tss_host h = n->host;
    tss_free(&h, n->p, n->p_bytes);
    tss_free(&h, n->from, n->from_bytes);
    tss_free(&h, n, sizeof *n);
}

static void tss__net_seed(tss_net *n, uint64_t seed) {
    tss_rng r = tss_rng_seed(seed);
    for (int l = 0; l < n->layers; l++) {
        double bound = 1 / sqrt((double)n->width[l]);
        for (size_t i = n->theta[l]; i < n->theta[l + 1]; i++)
            n->par[i] = bound * (2 * tss_rng_uniform(&r) - 1);
    }
}

static const char *tss__net_fill(tss_net *n, const tss_net_def *d) {
    size_t part[5], wide = sizeof(double);
    tss__net_parts(n, part);
    if (d->in_base) memcpy(n->in_base, d->in_base, part[1] * wide);
    if (d->in_matrix) memcpy(n->in_matrix, d->in_matrix, part[2] * wide);
    if (d->out_base) memcpy(n->out_base, d->out_base, part[3] * wide);
    if (d->out_matrix) memcpy(n->out_matrix, d->out_matrix, part[4] * wide);
    for (size_t i = part[0]; i < part[0] + part[1] + part[2] + part[3] + part[4]; i++)
        if (!isfinite(n->p[i])) return "network: a base or matrix is not finite";
    for (int i = 0; n->from && i < n->outputs; i++) n->from[i] = d->out_index ? -1 : i;
    for (int i = 0; d->out_index && n->from && i < n->width[n->layers]; i++) {
        if (n->from[d->out_index[i]] >= 0) return "network: out_index names a coordinate twice";
        n->from[d->out_index[i]] = i;
    }
    return NULL;
}

tss_result tss_net_create(const tss_host *host, const tss_net_def *d, tss_net **out) {
    tss_host h = host ? *host : tss_host_default();
    *out = NULL;
    TSS_ASSERT(d->cookie == TSS__NET_COOKIE && "tss_net_def: start from tss_net_def_default");
    const char *wrong = tss__net_complaint(d);
    if (wrong) return tss__n_refuse(&h, TSS_ERROR_BAD_ARGUMENT, wrong);
    tss_net *n = (tss_net *)tss_alloc(&h, sizeof *n);
    if (!n) return TSS_ERROR_NO_MEMORY;
    memset(n, 0, sizeof *n);
    n->host = h, n->layers = d->layers, n->activation = d->activation, n->scale = d->out_scale;
    memcpy(n->width, d->width, (size_t)(d->layers + 1) * sizeof(int));
    n->has_in = d->in_matrix != NULL;
    n->map = d->out_matrix ? TSS__MAP_MATRIX : d->outputs ? TSS__MAP_SCATTER : TSS__MAP_NONE;
    n->inputs = n->has_in ? d->inputs : n->width[0];
    n->outputs = n->map ? d->outputs : n->width[n->layers];
    tss__net_layout(n);
    if (!tss__net_arrays(n)) {
        tss_net_destroy(n);
        return TSS_ERROR_NO_MEMORY;
    }
    wrong = tss__net_fill(n, d);
    if (wrong) {
        tss_net_destroy(n);
        return tss__n_refuse(&h, TSS_ERROR_BAD_ARGUMENT, wrong);
    }
    tss__net_seed(n, d->seed);
    *out = n;
    return TSS_OK;
}

void tss_net_get_info(const tss_net *n, tss_net_info *out) {
    out->layers = n->layers, out->inputs = n->inputs, out->outputs = n->outputs;
    out->width = n->width, out->activation = n->activation;
    out->parameters = n->theta[n->layers], out->out_scale = n->scale;
}

double *tss_net_parameters(tss_net *n) { return n->par; }
void tss_net_set_scale(tss_net *n, double s) { n->scale = s; }

// ---------------------------------------------------------------------------------------------
// >>passes (private)
// A pass is a batch of jets on its way through a net. A sample has cols = 1 + k (+ 1) rows: y, the
// y_a, y_2. Linear layers treat all rows alike (b goes to y alone). Through an activation h = σ(s):
//     h_a = σ' s_a,    h_2 = σ'' Σ_ab C_ab s_a s_b + σ' s_2,
// and back, with ŝ_a = Σ_b C_ab s_b:
//     s̄_2 = σ' h̄_2,   s̄_a = σ' h̄_a + 2 σ'' ŝ_a h̄_2,
//     s̄  = σ' h̄ + Σ_a σ'' s_a h̄_a + (σ''' Σ_a s_a ŝ_a + σ'' s_2) h̄_2.
// The tangent of the first-order reverse pass, for Hessians: b' = σ' b, b'_a = σ' b_a + σ'' s_a b.
// ---------------------------------------------------------------------------------------------

// 1: k² and rows of a batch of jets are numbers that an int holds.
static int tss__n_sizes(int batch, int k) {
    return batch >= 1 && k >= 0 && k <= 32768 && (double)batch * ((double)k + 2) < 2147483647.0;
}

typedef struct tss__jetpass {
    const tss_net *net;
    int batch, k, second, cols, chunks;
    size_t coords;              // columns of x: all outputs, or those of dof
    const int *dof;             // coordinates wanted, NULL: all
    const double *C;            // batch × k × k, or NULL
    double *act, *pre;          // tapes: layer l at rows·off[l]
    double *x, *xbar;           // rows × coords
    double *theta;              // chunks × parameters, or NULL
    double *scratch;            // chunks × scratch_each
    size_t most, scratch_each;  // most: rows of a chunk
} tss__jetpass;

static int tss__jetpass_sample(const tss__jetpass *p, int c) {
    return (int)((int64_t)p->batch * c / p->chunks);
}
static int tss__jetpass_samples(const tss__jetpass *p, int c) {
    return tss__jetpass_sample(p, c + 1) - tss__jetpass_sample(p, c);
}
static size_t tss__jetpass_row(const tss__jetpass *p, int c) {
    return (size_t)tss__jetpass_sample(p, c) * (size_t)p->cols;
}
static size_t tss__jetpass_rows(const tss__jetpass *p, int c) {
    return (size_t)tss__jetpass_samples(p, c) * (size_t)p->cols;
}
static double *tss__jetpass_layer(const tss__jetpass *p, double *tape, int c, int l) {
    size_t rows = (size_t)p->batch * (size_t)p->cols;
    return tape + rows * p->net->off[l] + tss__jetpass_row(p, c) * (size_t)p->net->width[l];
}

enum { TSS__PASS_X = 1, TSS__PASS_XBAR = 2, TSS__PASS_THETA = 4 };

static tss__jetpass tss__jetpass_of(const tss_net *n, int batch, int k, const double *C,
                                    const int *dof, int coords) {
    tss__jetpass p;
    memset(&p, 0, sizeof p);
    p.net = n, p.batch = batch, p.k = k, p.second = C != NULL, p.C = C;
    p.cols = 1 + k + p.second;
    p.chunks = batch < TSS__N_CHUNKS ? batch : TSS__N_CHUNKS;
    p.most = (size_t)((batch + p.chunks - 1) / p.chunks) * (size_t)p.cols;
    p.dof = dof, p.coords = dof ? (size_t)coords : (size_t)n->outputs;
    return p;
}

static void tss__jetpass_plan(tss__jetpass *p, tss__n_slab *s, int what) {
    const tss_net *n = p->net;
    double rows = (double)p->batch * p->cols;
    size_t widest = (size_t)n->widest, longest = widest, ends = 0;
    if (p->most > longest) longest = p->most;
    if (n->map && p->coords > longest) longest = p->coords;
    if (n->has_in) ends = p->most * (size_t)n->inputs;
    if (n->has_in && (size_t)n->inputs > longest) longest = (size_t)n->inputs;
    p->act = tss__n_take(s, rows, n->off[n->layers]);
    p->pre = tss__n_take(s, rows, n->off[n->layers + 1]);
    p->x = what & TSS__PASS_X ? tss__n_take(s, rows, p->coords) : NULL;
    p->xbar = what & TSS__PASS_XBAR ? tss__n_take(s, rows, p->coords) : NULL;
    p->theta = what & TSS__PASS_THETA ? tss__n_take(s, p->chunks, n->theta[n->layers]) : NULL;
    // Two adjoints, ŝ, a panel, an encoder's input.
    p->scratch_each = (2 * p->most + (size_t)p->k) * widest + 8 * longest + ends;
    p->scratch = tss__n_take(s, p->chunks, p->scratch_each);
}

static double *tss__jetpass_scratch(const tss__jetpass *p, int c) {
    return p->scratch + (size_t)c * p->scratch_each;
}
static double *tss__jetpass_hat(const tss__jetpass *p, int c) {
    return tss__jetpass_scratch(p, c) + 2 * p->most * (size_t)p->net->widest;
}
static double *tss__jetpass_panel(const tss__jetpass *p, int c) {
    return tss__jetpass_hat(p, c) + (size_t)p->k * (size_t)p->net->widest;
}

// The chunk's inputs: rows of `in`, directions D (sample s's at s·stride), 0 for the second order.
static void tss__jetpass_load(const tss__jetpass *p, int c, const double *in, const double *D,
                              size_t stride) {
    const tss_net *n = p->net;
    size_t r = (size_t)n->width[0], full = (size_t)n->inputs;
    double *to = tss__jetpass_layer(p, p->act, c, 0), *panel = tss__jetpass_panel(p, c);
    tss__n_zero(to, tss__jetpass_rows(p, c) * r);
    int first = tss__jetpass_sample(p, c), count = tss__jetpass_samples(p, c);
    double *moved = tss__jetpass_scratch(p, c) + p->scratch_each - (n->has_in ? p->most * full : 0);
    for (int s = 0; s < count; s++) {
        double *row = to + (size_t)(s * p->cols) * r;
        const double *x = in + (size_t)(first + s) * full;
        if (n->has_in)
            for (size_t i = 0; i < full; i++) moved[(size_t)s * full + i] = x[i] - n->in_base[i];
        else
            memcpy(row, x, r * sizeof(double));
        if (p->k && D)
            memcpy(row + r, D + (size_t)(first + s) * stride, (size_t)p->k * r * sizeof(double));
    }
    if (n->has_in)
        tss__n_product((size_t)count, r, full, tss__n_rows(moved, full),
                       tss__n_rows(n->in_matrix, r), to, r, panel);
}

// hat[a] = Σ_b C_ab s_b of one sample; s: its rows, width w.
static void tss__jetpass_hats(const tss__jetpass *p, int sample, const double *s, size_t w,
                              double *hat) {
    const double *C = p->C + (size_t)sample * (size_t)(p->k * p->k);
    tss__n_zero(hat, (size_t)p->k * w);
    for (int a = 0; a < p->k; a++)
        for (int b = 0; b < p->k; b++) {
            double f = C[a * p->k + b];
            if (f == 0) continue;
            for (size_t o = 0; o < w; o++) hat[(size_t)a * w + o] += f * s[(size_t)(b + 1) * w + o];
        }
}

static void tss__jetpass_activate(const tss__jetpass *p, int c, int l) {
    size_t w = (size_t)p->net->width[l], k = (size_t)p->k;
    double *S = tss__jetpass_layer(p, p->pre, c, l), *H = tss__jetpass_layer(p, p->act, c, l);
    double *hat = tss__jetpass_hat(p, c);
    int first = tss__jetpass_sample(p, c), count = tss__jetpass_samples(p, c);
    for (int i = 0; i < count; i++, S += (size_t)p->cols * w, H += (size_t)p->cols * w) {
        if (p->second) tss__jetpass_hats(p, first + i, S, w, hat);
        for (size_t o = 0; o < w; o++) {
            double d[4], curve = 0;
            tss__n_activate(p->net->activation, S[o], d);
            H[o] = d[0];
            for (size_t a = 0; a < k; a++) H[(a + 1) * w + o] = d[1] * S[(a + 1) * w + o];
            if (!p->second) continue;
            for (size_t a = 0; a < k; a++) curve += S[(a + 1) * w + o] * hat[a * w + o];
            H[(k + 1) * w + o] = d[2] * curve + d[1] * S[(k + 1) * w + o];
        }
    }
}

static void tss__jetpass_forward(const tss__jetpass *p, int c) {
    const tss_net *n = p->net;
    size_t rows = tss__jetpass_rows(p, c);
    for (int l = 0; l < n->layers; l++) {
        size_t in = (size_t)n->width[l], out = (size_t)n->width[l + 1];
        const double *W = n->par + n->theta[l], *b = W + in * out;
        double *S = tss__jetpass_layer(p, p->pre, c, l + 1);
        tss__n_zero(S, rows * out);
        for (size_t r = 0; r < rows; r += (size_t)p->cols) memcpy(S + r * out, b, out * sizeof *b);
        tss__n_product(rows, out, in, tss__n_rows(tss__jetpass_layer(p, p->act, c, l), in),
                       tss__n_rows(W, out), S, out, tss__jetpass_panel(p, c));
        if (l + 1 < n->layers) tss__jetpass_activate(p, c, l + 1);
    }
}

// The adjoint of one sample's unit: h̄ in place to s̄. step: distance of the unit's rows.
static void tss__unit_reverse(const tss__jetpass *p, const double d[4], const double *S,
                              const double *hat, double *bar, size_t step) {
    size_t k = (size_t)p->k;
    double base = d[1] * bar[0], h2 = p->second ? bar[(k + 1) * step] : 0, curve = 0;
    for (size_t a = 1; a <= k; a++) {
        base += d[2] * S[a * step] * bar[a * step];
        bar[a * step] *= d[1];
        if (!p->second) continue;
        curve += S[a * step] * hat[(a - 1) * step];
        bar[a * step] += 2 * d[2] * hat[(a - 1) * step] * h2;
    }
    if (p->second) {
        base += (d[3] * curve + d[2] * S[(k + 1) * step]) * h2;
        bar[(k + 1) * step] = d[1] * h2;
    }
    bar[0] = base;
}

static void tss__unit_tangent(int k, const double d[4], const double *S, double *bar, size_t step) {
    for (size_t a = 1; a <= (size_t)k; a++)
        bar[a * step] = d[1] * bar[a * step] + d[2] * S[a * step] * bar[0];
    bar[0] *= d[1];
}

static void tss__jetpass_deactivate(const tss__jetpass *p, int c, int l, int tangent, double *bar) {
    size_t w = (size_t)p->net->width[l];
    double *S = tss__jetpass_layer(p, p->pre, c, l), *hat = tss__jetpass_hat(p, c);
    int first = tss__jetpass_sample(p, c), count = tss__jetpass_samples(p, c);
    for (int i = 0; i < count; i++, S += (size_t)p->cols * w, bar += (size_t)p->cols * w) {
        if (p->second) tss__jetpass_hats(p, first + i, S, w, hat);
        for (size_t o = 0; o < w; o++) {
            double d[4];
            tss__n_activate(p->net->activation, S[o], d);
            if (tangent)
                tss__unit_tangent(p->k, d, S + o, bar + o, w);
            else
                tss__unit_reverse(p, d, S + o, hat + o, bar + o, w);
        }
    }
}

// W̄ and b̄ of layer l: all rows count for W, the first of each sample for b.
static void tss__jetpass_theta(const tss__jetpass *p, int c, int l, const double *bar) {
    const tss_net *n = p->net;
    size_t in = (size_t)n->width[l], out = (size_t)n->width[l + 1], rows = tss__jetpass_rows(p, c);
    double *W = p->theta + (size_t)c * n->theta[n->layers] + n->theta[l], *b = W + in * out;
    tss__n_product(in, out, rows,
                   tss__n_turned(tss__n_rows(tss__jetpass_layer(p, p->act, c, l), in)),
                   tss__n_rows(bar, out), W, out, tss__jetpass_panel(p, c));
    for (size_t r = 0; r < rows; r += (size_t)p->cols)
        for (size_t o = 0; o < out; o++) b[o] += bar[r * out + o];
}

// From the adjoint of the MLP's output rows (in the first half of the scratch) to that of its input
// rows, which is returned; parameters on the way if the pass has θ̄.
static double *tss__jetpass_backward(const tss__jetpass *p, int c, int tangent) {
    const tss_net *n = p->net;
    size_t rows = tss__jetpass_rows(p, c);
    double *bar = tss__jetpass_scratch(p, c), *next = bar + p->most * (size_t)n->widest;
    if (p->theta) tss__n_zero(p->theta + (size_t)c * n->theta[n->layers], n->theta[n->layers]);
    for (int l = n->layers - 1; l >= 0; l--) {
        size_t in = (size_t)n->width[l], out = (size_t)n->width[l + 1];
        if (p->theta) tss__jetpass_theta(p, c, l, bar);
        tss__n_zero(next, rows * in);
        tss__n_product(rows, in, out, tss__n_rows(bar, out),
                       tss__n_turned(tss__n_rows(n->par + n->theta[l], out)), next, in,
                       tss__jetpass_panel(p, c));
        if (l > 0) tss__jetpass_deactivate(p, c, l, tangent, next);
        double *swap = bar;
        bar = next, next = swap;
    }
    return bar;
}

// The last map: rows of the MLP's output to rows of coordinates, x0 added to the base rows.
static void tss__jetpass_out(const tss__jetpass *p, int c) {
    const tss_net *n = p->net;
    size_t rows = tss__jetpass_rows(p, c), w = (size_t)n->width[n->layers], T = p->coords;
    const double *y = tss__jetpass_layer(p, p->pre, c, n->layers);
    double *x = p->x + tss__jetpass_row(p, c) * T;
    for (size_t r = 0; r < rows; r++)
        for (size_t t = 0; t < T; t++) {
            size_t at = p->dof ? (size_t)p->dof[t] : t;
            int from = n->map == TSS__MAP_SCATTER ? n->from[at] : (int)at;
            double base = n->map && r % (size_t)p->cols == 0 ? n->out_base[at] : 0;
            if (n->map == TSS__MAP_SCATTER)
                base += from < 0 ? 0 : n->scale * y[r * w + (size_t)from];
            else if (n->map == TSS__MAP_NONE)
                base = y[r * w + at];
            x[r * T + t] = base;
        }
    if (n->map != TSS__MAP_MATRIX) return;
    tss__n_view B = tss__n_rows(n->out_matrix, w);
    B.ri = p->dof;
    tss__n_product(rows, T, w, tss__n_rows(y, w), tss__n_turned(B), x, T, tss__jetpass_panel(p, c));
}

// The adjoint of the last map, x̄ rows to the first half of the scratch.
static void tss__jetpass_in_bar(const tss__jetpass *p, int c, const double *xbar) {
    const tss_net *n = p->net;
    size_t rows = tss__jetpass_rows(p, c), w = (size_t)n->width[n->layers], T = p->coords;
    double *bar = tss__jetpass_scratch(p, c);
    tss__n_zero(bar, rows * w);
    if (n->map == TSS__MAP_MATRIX) {
        tss__n_view B = tss__n_rows(n->out_matrix, w);
        B.ri = p->dof;
        tss__n_product(rows, w, T, tss__n_rows(xbar, T), B, bar, w, tss__jetpass_panel(p, c));
        return;
    }
    for (size_t r = 0; r < rows; r++)
        for (size_t t = 0; t < T; t++) {
            size_t at = p->dof ? (size_t)p->dof[t] : t;
            int from = n->map == TSS__MAP_SCATTER ? n->from[at] : (int)at;
            if (from >= 0) bar[r * w + (size_t)from] += (n->map ? n->scale : 1) * xbar[r * T + t];
        }
}

static double *tss__jetpass_xbar(const tss__jetpass *p, int c) {
    return p->xbar + tss__jetpass_row(p, c) * p->coords;
}

// theta_bar += weight · the chunks' gradients, summed in the order of the chunks.
typedef struct tss__n_sum {
    const tss__jetpass *p;
    double weight, *to;
} tss__n_sum;

static void tss__n_sum_task(int block, int worker, void *arg) {
    (void)worker;
    const tss__n_sum *s = (const tss__n_sum *)arg;
    size_t all = s->p->net->theta[s->p->net->layers], first = (size_t)block * 4096;
    size_t end = first + 4096 < all ? first + 4096 : all;
    for (size_t i = first; i < end; i++) {
        double sum = 0;
        for (int c = 0; c < s->p->chunks; c++) sum += s->p->theta[(size_t)c * all + i];
        s->to[i] += s->weight * sum;
    }
}

static void tss__jetpass_collect(const tss_host *host, const tss__jetpass *p, double weight,
                                 double *to) {
    tss__n_sum s = {p, weight, to};
    size_t all = p->net->theta[p->net->layers];
    if (to) tss_parallel(host, (int)((all + 4095) / 4096), tss__n_sum_task, &s);
}

// ---- the public passes ----------------------------------------------------------------------

typedef struct tss__n_job {  // of forward, backward and jets
    tss__jetpass p;
    const double *in, *D, *out_bar;
    double *out, *x1, *x2, *in_bar;
} tss__n_job;

static void tss__n_forward_task(int c, int worker, void *arg) {
    (void)worker;
    tss__n_job *j = (tss__n_job *)arg;
    const tss__jetpass *p = &j->p;
    size_t n = p->coords, k = (size_t)p->k, wide = n * sizeof(double);
    tss__jetpass_load(p, c, j->in, j->D, k * (size_t)p->net->width[0]);
    tss__jetpass_forward(p, c);
    tss__jetpass_out(p, c);
    int first = tss__jetpass_sample(p, c), count = tss__jetpass_samples(p, c);
    for (int i = 0; i < count; i++) {
        size_t s = (size_t)(first + i);
        const double *x = p->x + s * (size_t)p->cols * n;
        if (j->out) memcpy(j->out + s * n, x, wide);
        if (j->x1 && k) memcpy(j->x1 + s * k * n, x + n, k * wide);
        if (j->x2 && p->second) memcpy(j->x2 + s * n, x + (k + 1) * n, wide);
    }
}

tss_result tss_net_jets(const tss_net *n, tss_work *w, int batch, int k, const double *z,
                        const double *D, const double *C, double *x, double *x1, double *x2) {
    if (!tss__n_sizes(batch, k) || (k > 0 && !D) || (k > 0 && n->has_in) || (x2 && !C))
        return TSS_ERROR_BAD_ARGUMENT;
    tss__n_job j;
    tss__n_slab s = {NULL, 0, 0};
    memset(&j, 0, sizeof j);
    j.p = tss__jetpass_of(n, batch, k, k ? C : NULL, NULL, 0);
    tss__jetpass_plan(&j.p, &s, TSS__PASS_X);
    if (!tss__n_room(w, &s)) return TSS_ERROR_NO_MEMORY;
    tss__jetpass_plan(&j.p, &s, TSS__PASS_X);
    j.in = z, j.D = D, j.out = x, j.x1 = x1, j.x2 = x2;
    if (x2 && k == 0) tss__n_zero(x2, (size_t)batch * (size_t)n->outputs);
    tss_parallel(&w->host, j.p.chunks, tss__n_forward_task, &j);
    return TSS_OK;
}

tss_result tss_net_forward(const tss_net *n, tss_work *w, int batch, const double *in,
                           double *out) {
    return tss_net_jets(n, w, batch, 0, in, NULL, NULL, out, NULL, NULL);
}

// in_bar (samples × inputs) += the adjoint of the net's inputs from that of the MLP's.
static void tss__jetpass_inputs(const tss__jetpass *p, int c, const double *bar, double *in_bar) {
    const tss_net *n = p->net;
    size_t r = (size_t)n->width[0], full = (size_t)n->inputs;
    int first = tss__jetpass_sample(p, c), count = tss__jetpass_samples(p, c);
    double *to = in_bar + (size_t)first * full;
    if (n->has_in) {
        tss__n_product((size_t)count, full, r, tss__n_rows(bar, r),
                       tss__n_turned(tss__n_rows(n->in_matrix, r)), to, full,
                       tss__jetpass_panel(p, c));
        return;
    }
    for (int s = 0; s < count; s++)
        for (size_t i = 0; i < r; i++) to[(size_t)s * r + i] += bar[(size_t)(s * p->cols) * r + i];
}

static void tss__n_backward_task(int c, int worker, void *arg) {
    (void)worker;
    tss__n_job *j = (tss__n_job *)arg;
    const tss__jetpass *p = &j->p;
    tss__jetpass_load(p, c, j->in, NULL, 0);
    tss__jetpass_forward(p, c);
    tss__jetpass_in_bar(p, c, j->out_bar + tss__jetpass_row(p, c) * p->coords);
    const double *bar = tss__jetpass_backward(p, c, 0);
    if (j->in_bar) tss__jetpass_inputs(p, c, bar, j->in_bar);
}

tss_result tss_net_backward(const tss_net *n, tss_work *w, int batch, const double *in,
                            const double *out_bar, double *theta_bar, double *in_bar) {
    if (!tss__n_sizes(batch, 0) || !out_bar) return TSS_ERROR_BAD_ARGUMENT;
    tss__n_job j;
    tss__n_slab s = {NULL, 0, 0};
    int what = theta_bar ? TSS__PASS_THETA : 0;
    memset(&j, 0, sizeof j);
    j.p = tss__jetpass_of(n, batch, 0, NULL, NULL, 0);
    tss__jetpass_plan(&j.p, &s, what);
    if (!tss__n_room(w, &s)) return TSS_ERROR_NO_MEMORY;
    tss__jetpass_plan(&j.p, &s, what);
    j.in = in, j.out_bar = out_bar, j.in_bar = in_bar;
    tss_parallel(&w->host, j.p.chunks, tss__n_backward_task, &j);
    tss__jetpass_collect(&w->host, &j.p, 1, theta_bar);
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>neural_elements (private)
// With G = F − I, j = J − 1, K = cof F, and II, III the second and third invariants:
//     Ψ = μ/2 (‖G‖² − 2 II(G) − 2 III(G)) + λ'/2 j²,  j = tr G + II(G) + III(G),
// without cancellation near rest. Where the strain δ = FᵀF − I is small, however far the cell has
// turned,
//     Ψ = μ/2 (j² − II(δ) − III(δ)) + λ'/2 j²,  j = (tr + II + III)(δ) / (1 + J)
// has a rounding of μ|δ| and not of μ (it follows from J² = det(I + δ)). Derivatives:
//     Ψ'      = μ (F − K) + λ' j K
//     Ψ''[A]  = μ A + λ' (K:A) K + c K'[A],   c = λ' j − μ
//     Ψ'''[A, B] = λ' ((K:A) K'[B] + (K:B) K'[A] + (K'[A]:B) K) + c K''[A, B].
// In 3D K'[A] = F ⨯ A and K''[A, B] = A ⨯ B (the tensor cross product, ½ F ⨯ F = K); in 2D K is
// linear.
// ---------------------------------------------------------------------------------------------

#define TSS__ELEMENTS_COOKIE 0x656c65
#define TSS__N_CELL 12  // numbers of a cell or hinge in a column of scratch

struct tss_elements {
    tss_host host;
    int dim, nodes, cells;  // cells: of the subset
    int per;                // nodes of a cell
    int hinges;             // of a shell
    int used;               // nodes that have a cell
    void *p;                // one block
    size_t bytes;
    double *Dinv, *vol, *mu, *la;  // cells × d², then w·vol, μ, λ'
    int *cell, *local;             // cells × (d+1): nodes; the same, numbered within dof
    int *dof;                      // used × d coordinates
    double thick;                  // of a shell, m; 0: not one. Its Dinv are 2 × 2
    double *rest, *hinge_weight;   // one block, hinges: θ̄; the shares of the two cells
    int *hinge, *hinge_local;      // hinges × 4 nodes: an edge, the nodes across
    int *cell_hinge;               // cells × 3: 2·hinge + which of its cells this is, −1: none
    size_t hinge_bytes;
};

static void tss__mat_cross(const double A[9], const double B[9], double out[9]) {
    static const int next[3] = {1, 2, 0}, last[3] = {2, 0, 1};
    for (int i = 0; i < 3; i++)
        for (int I = 0; I < 3; I++) {
            int a = 3 * next[i] + next[I], b = 3 * last[i] + last[I];
            int c = 3 * next[i] + last[I], d = 3 * last[i] + next[I];
            out[3 * i + I] = A[a] * B[b] - A[c] * B[d] + A[b] * B[a] - A[d] * B[c];
        }
}

static void tss__cof2(const double A[4], double out[4]) {
    double a = A[0], b = A[1], c = A[2], d = A[3];
    out[0] = d, out[1] = -c, out[2] = -b, out[3] = a;
}

// K'[A] at F, and K''[A, B].
static void tss__cof_d(int d, const double *F, const double *A, double *out) {
    if (d == 3)
        tss__mat_cross(F, A, out);
    else
        tss__cof2(A, out);
}
static void tss__cof_dd(int d, const double *A, const double *B, double *out) {
    if (d == 3)
        tss__mat_cross(A, B, out);
    else
        out[0] = out[1] = out[2] = out[3] = 0;
}

static double tss__dot_n(int n, const double *a, const double *b) {
    double s = 0;
    for (int i = 0; i < n; i++) s += a[i] * b[i];
    return s;
}

typedef struct tss__n_cell {  // one cell at one F
    int d, dd;
    double mu, la, j, c, psi;
    double F[9], K[9], P[9];
} tss__n_cell;

// Invariants of a d × d matrix: trace, second, determinant (0 for d = 2).
static void tss__invariants(int d, const double *A, double inv[3]) {
    double C[9];
    if (d == 2) {
        inv[0] = A[0] + A[3], inv[1] = A[0] * A[3] - A[1] * A[2], inv[2] = 0;
        return;
    }
    tss__mat_cross(A, A, C);
    inv[0] = A[0] + A[4] + A[8], inv[1] = 0.5 * (C[0] + C[4] + C[8]);
    inv[2] = tss__dot_n(9, C, A) / 6;
}

#define TSS__N_SMALL (1.0 / 64)  // ‖δ‖² up to which the form in δ is used, as in tss.h

static void tss__cell_at(tss__n_cell *q, int d, double mu, double la, const double *F) {
    double G[9], delta[9], inv[3], gap;
    q->d = d, q->dd = d * d, q->mu = mu, q->la = la;
    for (int i = 0; i < q->dd; i++) q->F[i] = F[i], G[i] = F[i] - (i % (d + 1) == 0);
    tss__cof_d(d, F, F, q->K);
    for (int i = 0; d == 3 && i < 9; i++) q->K[i] *= 0.5;
    tss__invariants(d, G, inv);
    q->j = inv[0] + inv[1] + inv[2], gap = tss__dot_n(q->dd, G, G) - 2 * inv[1] - 2 * inv[2];
    for (int r = 0; r < d; r++)
        for (int c = 0; c < d; c++) {
            double s = 0;
            for (int m = 0; m < d; m++) s += G[m * d + r] * G[m * d + c];
            delta[r * d + c] = G[r * d + c] + G[c * d + r] + s;
        }
    if (tss__dot_n(q->dd, delta, delta) <= TSS__N_SMALL && q->j > -1) {
        tss__invariants(d, delta, inv);
        q->j = (inv[0] + inv[1] + inv[2]) / (2 + q->j);
        gap = q->j * q->j - inv[1] - inv[2];
    }
    q->c = la * q->j - mu, q->psi = 0.5 * (mu * gap + la * q->j * q->j);
    for (int i = 0; i < q->dd; i++) q->P[i] = mu * (F[i] - q->K[i]) + la * q->j * q->K[i];
}

// out += Ψ''[A].
static void tss__cell_dd(const tss__n_cell *q, const double *A, double *out) {
    double D[9], s = q->la * tss__dot_n(q->dd, q->K, A);
    tss__cof_d(q->d, q->F, A, D);
    for (int i = 0; i < q->dd; i++) out[i] += q->mu * A[i] + s * q->K[i] + q->c * D[i];
}

// out += w Ψ'''[A, B].
static void tss__cell_ddd(const tss__n_cell *q, double w, const double *A, const double *B,
                          double *out) {
    double a = tss__dot_n(q->dd, q->K, A), b = tss__dot_n(q->dd, q->K, B), mix[9], D[9], E[9];
    for (int i = 0; i < q->dd; i++) mix[i] = a * B[i] + b * A[i];
    tss__cof_d(q->d, q->F, mix, D);  // K' is linear: both terms at once
    tss__cof_d(q->d, q->F, A, mix);
    double ab = tss__dot_n(q->dd, mix, B);
    tss__cof_dd(q->d, A, B, E);
    for (int i = 0; i < q->dd; i++) out[i] += w * (q->la * (D[i] + ab * q->K[i]) + q->c * E[i]);
}

void tss_neural_density(void *user, int dim, int count, const int *cell, const double *F,
                        double *psi, double *P, double *C) {
    const double *lame = (const double *)user;
    int dd = dim * dim;
    (void)cell;
    for (int k = 0; k < count; k++) {
        tss__n_cell q;
        tss__cell_at(&q, dim, lame[0], lame[1] + lame[0], F + k * dd);
        if (psi) psi[k] = q.psi;
        if (P) memcpy(P + k * dd, q.P, (size_t)dd * sizeof(double));
        for (int a = 0; C && a < dd; a++) {
            double A[9] = {0}, *row = C + (k * dd + a) * dd;
            A[a] = 1;
            tss__n_zero(row, (size_t)dd);
            tss__cell_dd(&q, A, row);
        }
    }
}

tss_elements_def tss_elements_def_default(void) {
    tss_elements_def d;
    memset(&d, 0, sizeof d);
    d.dim = 3, d.E = 1e5, d.nu = 0.4, d.cookie = TSS__ELEMENTS_COOKIE;
    return d;
}

static const char *tss__elements_complaint(const tss_elements_def *d, tss_result *r) {
    *r = TSS_ERROR_BAD_ARGUMENT;
    int count = d->subset ? d->count : d->cells;
    if (d->dim != 2 && d->dim != 3) return "elements: dim must be 2 or 3";
    if (d->nodes < 1 || d->nodes > (1 << 28) || d->cells < 1 || d->cells > (1 << 27) || count < 1 ||
        count > d->cells)
        return "elements: nodes must be 1..2^28, cells 1..2^27, a subset 1..cells";
    if (!d->X || !d->cell || !d->mu != !d->lambda)
        return "elements: X, cell or one of mu, lambda missing";
    for (int i = 0; d->subset && i < count; i++)
        if (d->subset[i] < 0 || d->subset[i] >= d->cells) return "elements: subset out of range";
    for (int i = 0; d->weight && i < count; i++)
        if (!(d->weight[i] >= 0 && d->weight[i] < 1e300))
            return "elements: a weight is negative or not finite";
    *r = TSS_ERROR_BAD_MATERIAL;
    if (!d->mu && !(d->E > 0 && d->E < 1e300 && d->nu > -1 && d->nu < 0.5))
        return "elements: E or nu out of range";
    for (int i = 0; d->mu && i < d->cells; i++)
        if (!(d->mu[i] > 0 && d->mu[i] < 1e300 && d->lambda[i] > -d->mu[i] && d->lambda[i] < 1e300))
            return "elements: mu must be > 0 and lambda > −mu";
    if (!(d->shell >= 0 && d->shell < 1e300 && d->bending >= 0 && d->bending < 1e300))
        return "elements: shell or bending is negative or not finite";
    *r = TSS_ERROR_BAD_ARGUMENT;
    if (d->shell > 0 && d->dim != 3) return "elements: a shell is in space (dim 3)";
    if (d->bending > 0 && !(d->shell > 0)) return "elements: bending needs a shell";
    *r = TSS_ERROR_BAD_MESH;
    int per = d->shell > 0 ? 3 : d->dim + 1;
    for (int i = 0; i < d->cells * per; i++)
        if (d->cell[i] < 0 || d->cell[i] >= d->nodes)
            return "elements: a cell names a node out of range";
    for (int i = 0; i < d->nodes * d->dim; i++)
        if (!isfinite(d->X[i])) return "elements: a rest position is not finite";
    return NULL;
}

// D⁻¹ of the edges of a cell and its volume; <= 0: inverted or flat.
static double tss__cell_rest(int d, const double *X, const int *v, double *Dinv) {
    double D[9], K[9], det;
    for (int r = 0; r < d; r++)
        for (int m = 0; m < d; m++) D[r * d + m] = X[v[m + 1] * d + r] - X[v[0] * d + r];
    if (d == 3) {
        tss__mat_cross(D, D, K);
        for (int i = 0; i < 9; i++) K[i] *= 0.5;
    } else {
        tss__cof2(D, K);
    }
    det = D[0] * K[0] + D[1] * K[1] + (d == 3 ? D[2] * K[2] : 0);
    for (int r = 0; r < d; r++)
        for (int m = 0; m < d; m++) Dinv[m * d + r] = K[r * d + m] / det;
    return det / (d == 3 ? 6 : 2);
}

// ---- shells ---------------------------------------------------------------------------------
// Their gradients are written over hyper-dual numbers (Fike and Alonso 2011): v + a ε₁ + b ε₂
// + ab ε₁ε₂ with ε₁² = ε₂² = 0. At x + ε₁A + ε₂B they give ∇, D_A∇, D_B∇ and D²_AB∇, exactly; and
// once more over plain numbers, for where ∇ is all that is wanted.

typedef struct tss__hd {
    double v, a, b, ab;
} tss__hd;

static tss__hd tss__hd_of(double v) {
    tss__hd r = {v, 0, 0, 0};
    return r;
}
static tss__hd tss__hd_add(tss__hd x, tss__hd y) {
    tss__hd r = {x.v + y.v, x.a + y.a, x.b + y.b, x.ab + y.ab};
    return r;
}
static tss__hd tss__hd_sub(tss__hd x, tss__hd y) {
    tss__hd r = {x.v - y.v, x.a - y.a, x.b - y.b, x.ab - y.ab};
    return r;
}
static tss__hd tss__hd_scale(double f, tss__hd x) {
    tss__hd r = {f * x.v, f * x.a, f * x.b, f * x.ab};
    return r;
}
static tss__hd tss__hd_mul(tss__hd x, tss__hd y) {
    tss__hd r = {x.v * y.v, x.v * y.a + x.a * y.v, x.v * y.b + x.b * y.v,
                 x.v * y.ab + x.a * y.b + x.b * y.a + x.ab * y.v};
    return r;
}
// f(x) of a function with value f0 and derivatives f1, f2 at x.v.
static tss__hd tss__hd_chain(tss__hd x, double f0, double f1, double f2) {
    tss__hd r = {f0, f1 * x.a, f1 * x.b, f1 * x.ab + f2 * x.a * x.b};
    return r;
}
static tss__hd tss__hd_inverse(tss__hd x) {
    double i = 1 / x.v;
    return tss__hd_chain(x, i, -i * i, 2 * i * i * i);
}
static tss__hd tss__hd_sqrt(tss__hd x) {
    double s = sqrt(x.v);
    return tss__hd_chain(x, s, 0.5 / s, -0.25 / (s * x.v));
}
static tss__hd tss__hd_dot(const tss__hd *x, const tss__hd *y) {
    return tss__hd_add(tss__hd_add(tss__hd_mul(x[0], y[0]), tss__hd_mul(x[1], y[1])),
                       tss__hd_mul(x[2], y[2]));
}
static void tss__hd_cross(const tss__hd *x, const tss__hd *y, tss__hd *out) {
    for (int i = 0; i < 3; i++) {
        int j = (i + 1) % 3, k = (i + 2) % 3;
        out[i] = tss__hd_sub(tss__hd_mul(x[j], y[k]), tss__hd_mul(x[k], y[j]));
    }
}
// The angle of (x, y): that at the base, and the arc tangent (whose second derivative is 0 there)
// of what is left of it.
static tss__hd tss__hd_atan2(tss__hd y, tss__hd x) {
    double l = sqrt(x.v * x.v + y.v * y.v), c = x.v / l, s = y.v / l;
    tss__hd up = tss__hd_sub(tss__hd_scale(c, y), tss__hd_scale(s, x));
    tss__hd along = tss__hd_add(tss__hd_scale(c, x), tss__hd_scale(s, y));
    tss__hd t = tss__hd_mul(up, tss__hd_inverse(along));
    t.v = atan2(y.v, x.v);
    return t;
}

// A triangle: vol Ψ(F) of three nodes, F 3 × 2. With δ = FᵀF − I, n = F_0 × F_1 and J = |n|, as in
// the plane,
//     Ψ = μ/2 (j² − det δ) + λ'/2 j²,   j = J − 1 = (tr + det)(δ) / (1 + J),
//     Ψ' = μ F + (λ' j − μ) J',   J' = (F_1 × n, n × F_0) / J.
// J' is taken as 0 where a triangle has no area. Its gradient goes to g.
static double tss__shell_cell(const double *Dinv, double vol, double mu, double la,
                              const tss__hd *x, tss__hd *g) {
    tss__hd F[2][3], n[3], D[2][3], one = tss__hd_of(1);
    for (int r = 0; r < 3; r++) {
        tss__hd e = tss__hd_sub(x[3 + r], x[r]), f = tss__hd_sub(x[6 + r], x[r]);
        for (int m = 0; m < 2; m++)
            F[m][r] = tss__hd_add(tss__hd_scale(Dinv[m], e), tss__hd_scale(Dinv[2 + m], f));
    }
    tss__hd xx = tss__hd_sub(tss__hd_dot(F[0], F[0]), one), xy = tss__hd_dot(F[0], F[1]);
    tss__hd yy = tss__hd_sub(tss__hd_dot(F[1], F[1]), one);
    tss__hd det = tss__hd_sub(tss__hd_mul(xx, yy), tss__hd_mul(xy, xy));
    tss__hd more = tss__hd_add(tss__hd_add(xx, yy), det), J = tss__hd_of(0), inverse = J;
    tss__hd_cross(F[0], F[1], n);
    tss__hd square = tss__hd_dot(n, n);
    if (square.v > 1e-24) J = tss__hd_sqrt(square), inverse = tss__hd_inverse(J);
    tss__hd j = tss__hd_mul(more, tss__hd_inverse(tss__hd_add(one, J)));
    tss__hd s = tss__hd_mul(tss__hd_sub(tss__hd_scale(la, j), tss__hd_of(mu)), inverse);
    tss__hd_cross(F[1], n, D[0]), tss__hd_cross(n, F[0], D[1]);
    for (int r = 0; r < 3; r++) {
        tss__hd P[2];
        for (int m = 0; m < 2; m++)
            P[m] = tss__hd_add(tss__hd_scale(mu, F[m][r]), tss__hd_mul(s, D[m][r]));
        for (int i = 0; i < 2; i++)
            g[3 * (i + 1) + r] =
                tss__hd_scale(vol, tss__hd_add(tss__hd_scale(Dinv[2 * i], P[0]),
                                               tss__hd_scale(Dinv[2 * i + 1], P[1])));
        g[r] = tss__hd_scale(-1, tss__hd_add(g[3 + r], g[6 + r]));
    }
    return 0.5 * vol * (mu * (j.v * j.v - det.v) + la * j.v * j.v);
}

// A hinge: w (θ − rest)² of nodes 0, 1 (its edge) and 2, 3 (across), θ the angle between the
// normals, 0 when flat; ∂θ as in Bridson, Marino and Fedkiw 2003. *angle (NULL: not wanted): θ.
// Beside a triangle without area it is 0.
static double tss__shell_hinge(double w, double rest, const tss__hd *x, tss__hd *g, double *angle) {
    tss__hd e[3], a[4][3], N[2][3], across[3];  // a: nodes 2 and 3 seen from 0, then from 1
    for (int i = 0; i < 12; i++) g[i] = tss__hd_of(0);
    for (int r = 0; r < 3; r++) {
        e[r] = tss__hd_sub(x[3 + r], x[r]);
        for (int k = 0; k < 4; k++)
            a[k][r] = tss__hd_sub(x[6 + 3 * (k & 1) + r], x[3 * (k >> 1) + r]);
    }
    tss__hd_cross(a[0], a[2], N[0]), tss__hd_cross(a[3], a[1], N[1]);
    tss__hd E = tss__hd_dot(e, e), n[2] = {tss__hd_dot(N[0], N[0]), tss__hd_dot(N[1], N[1])};
    if (angle) *angle = 0;
    if (!(E.v > 0 && n[0].v > 0 && n[1].v > 0)) return 0;
    tss__hd l = tss__hd_sqrt(E), unit = tss__hd_inverse(l);
    tss__hd_cross(N[1], N[0], across);
    tss__hd theta =
        tss__hd_atan2(tss__hd_mul(tss__hd_dot(across, e), unit), tss__hd_dot(N[0], N[1]));
    if (angle) *angle = theta.v;
    tss__hd gap = tss__hd_sub(theta, tss__hd_of(rest)), f = tss__hd_scale(2 * w, gap);
    for (int k = 0; k < 2; k++) {  // shares of the two normals
        tss__hd q = tss__hd_mul(f, tss__hd_inverse(n[k])), from_e = tss__hd_mul(q, unit);
        tss__hd far = tss__hd_mul(q, l);
        tss__hd from0 = tss__hd_mul(tss__hd_dot(a[2 + k], e), from_e);
        tss__hd from1 = tss__hd_mul(tss__hd_dot(a[k], e), from_e);
        for (int r = 0; r < 3; r++) {
            g[6 + 3 * k + r] = tss__hd_mul(far, N[k][r]);
            g[r] = tss__hd_add(g[r], tss__hd_mul(from0, N[k][r]));
            g[3 + r] = tss__hd_sub(g[3 + r], tss__hd_mul(from1, N[k][r]));
        }
    }
    return w * gap.v * gap.v;
}

// ---- shells: the gradient alone -------------------------------------------------------------
// The operations of the two functions above in their order, so that bits agree (test_plain).

static double tss__n_dot3(const double *x, const double *y) {
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2];
}
static void tss__n_cross(const double *x, const double *y, double *out) {
    out[0] = x[1] * y[2] - x[2] * y[1], out[1] = x[2] * y[0] - x[0] * y[2];
    out[2] = x[0] * y[1] - x[1] * y[0];
}

static double tss__plain_cell(const double *Dinv, double vol, double mu, double la, const double *x,
                              double *g) {
    double F[2][3], n[3], D[2][3], J = 0, inverse = 0;
    for (int r = 0; r < 3; r++) {
        double e = x[3 + r] - x[r], f = x[6 + r] - x[r];
        F[0][r] = Dinv[0] * e + Dinv[2] * f, F[1][r] = Dinv[1] * e + Dinv[3] * f;
    }
    double xx = tss__n_dot3(F[0], F[0]) - 1, yy = tss__n_dot3(F[1], F[1]) - 1;
    double xy = tss__n_dot3(F[0], F[1]), det = xx * yy - xy * xy;
    tss__n_cross(F[0], F[1], n);
    double square = tss__n_dot3(n, n);
    if (square > 1e-24) J = sqrt(square), inverse = 1 / J;
    double j = (xx + yy + det) * (1 / (1 + J)), s = (la * j - mu) * inverse;
    tss__n_cross(F[1], n, D[0]), tss__n_cross(n, F[0], D[1]);
    for (int r = 0; r < 3; r++) {
        double P0 = mu * F[0][r] + s * D[0][r], P1 = mu * F[1][r] + s * D[1][r];
        g[3 + r] = vol * (Dinv[0] * P0 + Dinv[1] * P1);
        g[6 + r] = vol * (Dinv[2] * P0 + Dinv[3] * P1);
        g[r] = -(g[3 + r] + g[6 + r]);
    }
    return 0.5 * vol * (mu * (j * j - det) + la * j * j);
}

static double tss__plain_hinge(double w, double rest, const double *x, double *g) {
    double e[3], a[4][3], N[2][3], across[3];
    tss__n_zero(g, 12);
    for (int r = 0; r < 3; r++) {
        e[r] = x[3 + r] - x[r];
        a[0][r] = x[6 + r] - x[r], a[1][r] = x[9 + r] - x[r];
        a[2][r] = x[6 + r] - x[3 + r], a[3][r] = x[9 + r] - x[3 + r];
    }
    tss__n_cross(a[0], a[2], N[0]), tss__n_cross(a[3], a[1], N[1]);
    double E = tss__n_dot3(e, e), n0 = tss__n_dot3(N[0], N[0]), n1 = tss__n_dot3(N[1], N[1]);
    if (!(E > 0 && n0 > 0 && n1 > 0)) return 0;
    double l = sqrt(E), unit = 1 / l;
    tss__n_cross(N[1], N[0], across);
    double theta = atan2(tss__n_dot3(across, e) * unit, tss__n_dot3(N[0], N[1]));
    double gap = theta - rest, f = 2 * w * gap, q[2] = {f * (1 / n0), f * (1 / n1)};
    for (int k = 0; k < 2; k++) {
        double from_e = q[k] * unit, far = q[k] * l;
        double from0 = tss__n_dot3(a[2 + k], e) * from_e, from1 = tss__n_dot3(a[k], e) * from_e;
        for (int r = 0; r < 3; r++) {
            g[6 + 3 * k + r] = far * N[k][r];
            g[r] += from0 * N[k][r], g[3 + r] -= from1 * N[k][r];
        }
    }
    return w * gap * gap;
}

static double tss__plain_stencil(const tss_elements *e, int k, const double *x, double *g) {
    int hinge = k - e->cells;
    if (hinge < 0) return tss__plain_cell(e->Dinv + 4 * k, e->vol[k], e->mu[k], e->la[k], x, g);
    return tss__plain_hinge(e->hinge_weight[2 * hinge] + e->hinge_weight[2 * hinge + 1],
                            e->rest[hinge], x, g);
}

// Stencil k: a cell, or the hinge k − cells. Columns of 3·nodes numbers: x, A and B (NULL: 0).
static double tss__shell_stencil(const tss_elements *e, int k, const double *x, const double *A,
                                 const double *B, tss__hd *g) {
    tss__hd p[12];
    int hinge = k - e->cells;
    for (int i = 0; i < (hinge < 0 ? 9 : 12); i++) {
        p[i] = tss__hd_of(x[i]);
        if (A) p[i].a = A[i];
        if (B) p[i].b = B[i];
    }
    if (hinge < 0) return tss__shell_cell(e->Dinv + 4 * k, e->vol[k], e->mu[k], e->la[k], p, g);
    return tss__shell_hinge(e->hinge_weight[2 * hinge] + e->hinge_weight[2 * hinge + 1],
                            e->rest[hinge], p, g, NULL);
}

static const int *tss__shell_nodes(const tss_elements *e, const int *cell, const int *hinge, int k,
                                   int *count) {
    *count = k < e->cells ? 3 : 4;
    return k < e->cells ? cell + 3 * k : hinge + 4 * (k - e->cells);
}

static void tss__shell_gather(const double *x, const int *v, int count, double *to) {
    for (int i = 0; i < count; i++)
        for (int r = 0; r < 3; r++) to[3 * i + r] = x[3 * v[i] + r];
}

static double tss__shell_run(const tss_elements *e, const int *cell, const int *hinge,
                             const double *x, double *g) {
    double P = 0;
    for (int k = 0; k < e->cells + e->hinges; k++) {
        double at[12], G[12];
        int count;
        const int *v = tss__shell_nodes(e, cell, hinge, k, &count);
        tss__shell_gather(x, v, count, at);
        P += tss__plain_stencil(e, k, at, G);
        for (int i = 0; g && i < count; i++)
            for (int r = 0; r < 3; r++) g[3 * v[i] + r] += G[3 * i + r];
    }
    return P;
}

// ---- hinges of a shell ----------------------------------------------------------------------

typedef struct tss__n_edge {
    int lo, hi, cell, across;
} tss__n_edge;

static int tss__edge_order(const void *a, const void *b) {
    const tss__n_edge *p = (const tss__n_edge *)a, *q = (const tss__n_edge *)b;
    if (p->lo != q->lo) return p->lo < q->lo ? -1 : 1;
    if (p->hi != q->hi) return p->hi < q->hi ? -1 : 1;
    return p->cell < q->cell ? -1 : p->cell > q->cell;
}

// D⁻¹ (2 × 2) of a triangle in axes of its own, the first along its first edge; returns its area.
static double tss__shell_rest(const double *X, const int *v, double *Dinv) {
    double e[3], f[3], ef = 0, l = 0, area = 0;
    for (int r = 0; r < 3; r++) {
        e[r] = X[v[1] * 3 + r] - X[v[0] * 3 + r], f[r] = X[v[2] * 3 + r] - X[v[0] * 3 + r];
        l += e[r] * e[r], ef += e[r] * f[r];
    }
    for (int r = 0; r < 3; r++) {
        double n = e[(r + 1) % 3] * f[(r + 2) % 3] - e[(r + 2) % 3] * f[(r + 1) % 3];
        area += n * n;
    }
    l = sqrt(l), area = sqrt(area);
    // D = [l, ef/l; 0, area/l].
    Dinv[0] = 1 / l, Dinv[1] = -ef / (l * area), Dinv[2] = 0, Dinv[3] = l / area;
    return 0.5 * area;
}

// Sorts the edges of all cells. −1: an edge has more than two cells; else the hinges whose two
// cells are not both out of the subset (place < 0).
static int tss__shell_edges(const tss_elements_def *d, const int *place, tss__n_edge *edge) {
    int count = 0, all = 3 * d->cells;
    for (int k = 0; k < all; k++) {
        const int *v = d->cell + k / 3 * 3;
        int a = v[k % 3], b = v[(k + 1) % 3];
        tss__n_edge e = {a < b ? a : b, a < b ? b : a, k / 3, v[(k + 2) % 3]};
        edge[k] = e;
    }
    qsort(edge, (size_t)all, sizeof *edge, tss__edge_order);
    for (int k = 0; k + 1 < all; k++) {
        if (edge[k].lo != edge[k + 1].lo || edge[k].hi != edge[k + 1].hi) continue;
        if (k + 2 < all && edge[k].lo == edge[k + 2].lo && edge[k].hi == edge[k + 2].hi) return -1;
        count += place[edge[k].cell] >= 0 || place[edge[k + 1].cell] >= 0;
    }
    return count;
}

static void tss__shell_fill(tss_elements *e, const tss_elements_def *d, const int *place,
                            const tss__n_edge *edge) {
    int at = 0;
    for (int i = 0; i < 3 * e->cells; i++) e->cell_hinge[i] = -1;
    for (int k = 0; k + 1 < 3 * d->cells; k++) {
        if (edge[k].lo != edge[k + 1].lo || edge[k].hi != edge[k + 1].hi) continue;
        const tss__n_edge pair[2] = {edge[k], edge[k + 1]};
        if (place[pair[0].cell] < 0 && place[pair[1].cell] < 0) continue;
        int *v = e->hinge + 4 * at;
        double x[12], Dinv[4], area = 0, l = 0;
        tss__hd p[12], g[12];
        v[0] = pair[0].lo, v[1] = pair[0].hi, v[2] = pair[0].across, v[3] = pair[1].across;
        tss__shell_gather(d->X, v, 4, x);
        for (int i = 0; i < 12; i++) p[i] = tss__hd_of(x[i]);
        tss__shell_hinge(0, 0, p, g, &e->rest[at]);
        for (int r = 0; r < 3; r++) l += (x[3 + r] - x[r]) * (x[3 + r] - x[r]);
        for (int c = 0; c < 2; c++) area += tss__shell_rest(d->X, d->cell + 3 * pair[c].cell, Dinv);
        for (int c = 0; c < 2; c++) {
            int in = place[pair[c].cell], slot = 0;
            double w = in < 0 ? 0 : d->weight ? d->weight[in] : 1;
            e->hinge_weight[2 * at + c] = 0.5 * w * d->bending * 3 * l / area;
            if (in < 0) continue;
            while (e->cell_hinge[3 * in + slot] >= 0) slot++;
            e->cell_hinge[3 * in + slot] = 2 * at + c;
        }
        at++;
    }
}

static tss_result tss__shell_hinges(tss_elements *e, const tss_elements_def *d,
                                    const char **wrong) {
    size_t cells = (size_t)d->cells, bytes = cells * (3 * sizeof(tss__n_edge) + sizeof(int));
    tss__n_edge *edge = (tss__n_edge *)tss_alloc(&e->host, bytes);
    if (!edge) return TSS_ERROR_NO_MEMORY;
    int *place = (int *)(void *)(edge + 3 * cells);
    for (int k = 0; k < d->cells; k++) place[k] = d->subset ? -1 : k;
    for (int k = 0; d->subset && k < d->count; k++) place[d->subset[k]] = k;
    tss_result r = TSS_OK;
    double Dinv[4];
    for (int k = 0; k < d->cells; k++)
        if (!(tss__shell_rest(d->X, d->cell + 3 * k, Dinv) > 0)) r = TSS_ERROR_BAD_MESH;
    int count = tss__shell_edges(d, place, edge);
    size_t h = (size_t)(count > 0 ? count : 0), m = 3 * (size_t)e->cells;
    if (count < 0 && r == TSS_OK)
        r = TSS_ERROR_BAD_MESH, *wrong = "elements: more than two triangles share an edge";
    if (r == TSS_OK && count > 0) {
        e->hinge_bytes = 3 * h * sizeof(double) + (8 * h + m) * sizeof(int);
        e->rest = (double *)tss_alloc(&e->host, e->hinge_bytes);
        if (!e->rest) r = TSS_ERROR_NO_MEMORY;
    }
    if (r == TSS_OK && count > 0) {
        e->hinges = count, e->hinge_weight = e->rest + h;
        e->hinge = (int *)(void *)(e->hinge_weight + 2 * h), e->hinge_local = e->hinge + 4 * h;
        e->cell_hinge = e->hinge_local + 4 * h;
        tss__shell_fill(e, d, place, edge);
    }
    tss_free(&e->host, edge, bytes);
    return r;
}

static tss_result tss__elements_fill(tss_elements *e, const tss_elements_def *d, int *number) {
    int dim = e->dim, v = e->per;
    for (int i = 0; i < d->nodes; i++) number[i] = -1;
    for (int i = 0; i < 4 * e->hinges; i++) number[e->hinge[i]] = 0;
    for (int k = 0; k < e->cells; k++) {
        int at = d->subset ? d->subset[k] : k;
        double mu, la, vol;
        if (e->thick > 0)
            vol = e->thick * tss__shell_rest(d->X, d->cell + at * v, e->Dinv + k * 4);
        else
            vol = tss__cell_rest(dim, d->X, d->cell + at * v, e->Dinv + k * dim * dim);
        if (!(vol > 0 && vol < 1e300)) return TSS_ERROR_BAD_MESH;
        tss_lame(d->E, d->nu, &mu, &la);
        if (d->mu) mu = d->mu[at], la = d->lambda[at];
        e->vol[k] = vol * (d->weight ? d->weight[k] : 1), e->mu[k] = mu, e->la[k] = la + mu;
        for (int a = 0; a < v; a++) number[e->cell[k * v + a] = d->cell[at * v + a]] = 0;
    }
    for (int i = 0; i < d->nodes; i++) {  // in the order of the nodes
        if (number[i] < 0) continue;
        for (int a = 0; a < dim; a++) e->dof[e->used * dim + a] = i * dim + a;
        number[i] = e->used++;
    }
    for (int i = 0; i < e->cells * v; i++) e->local[i] = number[e->cell[i]];
    for (int i = 0; i < 4 * e->hinges; i++) e->hinge_local[i] = number[e->hinge[i]];
    return TSS_OK;
}

void tss_elements_destroy(tss_elements *e) {
    if (!e) return;
    tss_host h = e->host;
    tss_free(&h, e->p, e->bytes);
    tss_free(&h, e->rest, e->hinge_bytes);
    tss_free(&h, e, sizeof *e);
}

static tss_elements *tss__elements_alloc(const tss_host *h, const tss_elements_def *d) {
    tss_elements *e = (tss_elements *)tss_alloc(h, sizeof *e);
    if (!e) return NULL;
    memset(e, 0, sizeof *e);
    e->host = *h, e->dim = d->dim, e->per = d->shell > 0 ? 3 : d->dim + 1, e->thick = d->shell,
    e->nodes = d->nodes, e->cells = d->subset ? d->count : d->cells;
    size_t m = (size_t)e->cells, dim = (size_t)d->dim, most = (size_t)d->nodes;
    if (m * (dim + 1) < most && !(d->shell > 0))  // nodes that can be used
        most = m * (dim + 1);
    e->bytes =
        m * (dim * dim + 3) * sizeof(double) + (2 * m * (dim + 1) + most * dim) * sizeof(int);
    e->p = tss_alloc(h, e->bytes);
    if (!e->p) {
        tss_elements_destroy(e);
        return NULL;
    }
    e->Dinv = (double *)e->p, e->vol = e->Dinv + m * dim * dim, e->mu = e->vol + m,
    e->la = e->mu + m;
    e->cell = (int *)(void *)(e->la + m), e->local = e->cell + m * (dim + 1);
    e->dof = e->local + m * (dim + 1);
    return e;
}

tss_result tss_elements_create(const tss_host *host, const tss_elements_def *d,
                               tss_elements **out) {
    tss_host h = host ? *host : tss_host_default();
    tss_result r;
    *out = NULL;
    TSS_ASSERT(d->cookie == TSS__ELEMENTS_COOKIE && "tss_elements_def: start from the default");
    const char *wrong = tss__elements_complaint(d, &r);
    if (wrong) return tss__n_refuse(&h, r, wrong);
    tss_elements *e = tss__elements_alloc(&h, d);
    size_t bytes = (size_t)d->nodes * sizeof(int);
    int *number = e ? (int *)tss_alloc(&h, bytes) : NULL;
    if (!number) {
        tss_elements_destroy(e);
        return TSS_ERROR_NO_MEMORY;
    }
    wrong = "elements: a cell is flat or inverted";
    r = d->shell > 0 && d->bending > 0 ? tss__shell_hinges(e, d, &wrong) : TSS_OK;
    if (r == TSS_OK) r = tss__elements_fill(e, d, number);
    tss_free(&h, number, bytes);
    if (r != TSS_OK) {
        tss_elements_destroy(e);
        return r == TSS_ERROR_BAD_MESH ? tss__n_refuse(&h, r, wrong) : r;
    }
    *out = e;
    return TSS_OK;
}

// ---- jets of the elements -------------------------------------------------------------------

enum { TSS__CELL_VALUE, TSS__CELL_REVERSE, TSS__CELL_TANGENT };

typedef struct tss__n_jet {  // one sample; rows of x: base, k, second
    const tss_elements *e;
    const int *cell, *hinge;  // of e, or numbered as the rows are
    int mode, k, second;
    const double *x;
    size_t ld;        // from row to row
    const double *C;  // k × k, or NULL
    double alpha, gamma;
    const double *beta;  // k, or NULL: 0
    double *bar;         // rows as x, added to; NULL: VALUE
    double P, P2, *P1;   // P1: k, or NULL
    double *scratch;     // (3 cols + 2)·TSS__N_CELL
} tss__n_jet;

static void tss__jet_gather(const tss__n_jet *t, int k, int cols, double *F) {
    int d = t->e->dim;
    const int *v = t->cell + k * (d + 1);
    const double *Dinv = t->e->Dinv + k * d * d;
    for (int c = 0; c < cols; c++, F += 9) {
        const double *x = t->x + (size_t)c * t->ld;
        for (int r = 0; r < d; r++) {
            double edge[3], x0 = x[v[0] * d + r];
            for (int i = 0; i < d; i++) edge[i] = x[v[i + 1] * d + r] - x0;
            for (int m = 0; m < d; m++) {
                double s = 0;
                for (int i = 0; i < d; i++) s += edge[i] * Dinv[i * d + m];
                F[r * d + m] = s;
            }
        }
    }
}

static void tss__jet_scatter(const tss__n_jet *t, int k, int cols, const double *Fbar) {
    int d = t->e->dim;
    const int *v = t->cell + k * (d + 1);
    const double *Dinv = t->e->Dinv + k * d * d;
    for (int c = 0; c < cols; c++, Fbar += 9) {
        double *to = t->bar + (size_t)c * t->ld;
        for (int r = 0; r < d; r++)
            for (int i = 0; i < d; i++) {
                double s = t->e->vol[k] * tss__dot_n(d, Fbar + r * d, Dinv + i * d);
                to[v[i + 1] * d + r] += s, to[v[0] * d + r] -= s;
            }
    }
}

// F̂_a = Σ_b C_ab F_b, and the second-order value Σ_a Ψ''[F_a, F̂_a] + Ψ':F_2.
static double tss__jet_second(const tss__n_jet *t, const tss__n_cell *q, const double *F,
                              double *hat) {
    double s = tss__dot_n(q->dd, q->P, F + 9 * (t->k + 1));
    for (int a = 0; a < t->k; a++) {
        double *h = hat + 9 * a, D[9] = {0};
        tss__n_zero(h, 9);
        for (int b = 0; b < t->k; b++)
            for (int i = 0; i < q->dd; i++) h[i] += t->C[a * t->k + b] * F[9 * (b + 1) + i];
        tss__cell_dd(q, F + 9 * (a + 1), D);
        s += tss__dot_n(q->dd, D, h);
    }
    return s;
}

// The adjoint of alpha P + Σ beta_a P_a + gamma P_2 at one cell (docs/neural.md):
//     F̄_2 = γ Ψ',  F̄_a = β_a Ψ' + 2γ Ψ''[F̂_a],
//     F̄  = α Ψ' + Ψ''[Σ β_a F_a + γ F_2] + γ Σ Ψ'''[F_a, F̂_a].
static void tss__jet_reverse(const tss__n_jet *t, const tss__n_cell *q, const double *F,
                             const double *hat, double *bar) {
    int k = t->k, dd = q->dd;
    double mix[9] = {0};
    for (int i = 0; i < dd; i++) bar[i] = t->alpha * q->P[i];
    for (int a = 0; a < k; a++) {
        double *ba = bar + 9 * (a + 1), b = t->beta ? t->beta[a] : 0;
        for (int i = 0; i < dd; i++) ba[i] = b * q->P[i], mix[i] += b * F[9 * (a + 1) + i];
        if (!t->second) continue;
        double D[9] = {0};
        tss__cell_dd(q, hat + 9 * a, D);
        for (int i = 0; i < dd; i++) ba[i] += 2 * t->gamma * D[i];
        tss__cell_ddd(q, t->gamma, F + 9 * (a + 1), hat + 9 * a, bar);
    }
    for (int i = 0; t->second && i < dd; i++)
        bar[9 * (k + 1) + i] = t->gamma * q->P[i], mix[i] += t->gamma * F[9 * (k + 1) + i];
    if (k > 0) tss__cell_dd(q, mix, bar);
}

// The adjoint of P and its derivatives along the F_a.
static void tss__jet_tangent(const tss__n_jet *t, const tss__n_cell *q, const double *F,
                             double *bar) {
    memcpy(bar, q->P, (size_t)q->dd * sizeof(double));
    for (int a = 1; a <= t->k; a++) {
        tss__n_zero(bar + 9 * a, 9);
        tss__cell_dd(q, F + 9 * a, bar + 9 * a);
    }
}

// x̂_a = Σ_b C_ab x_b, and Σ β_a x_a + γ x_2.
static void tss__shell_mix(const tss__n_jet *t, const double *x, double *hat, double *mix) {
    tss__n_zero(mix, 12), tss__n_zero(hat, 12 * (size_t)t->k);
    for (int a = 0; a < t->k; a++)
        for (int i = 0; i < 12; i++) {
            mix[i] += t->beta ? t->beta[a] * x[12 * (a + 1) + i] : 0;
            for (int b = 0; t->second && b < t->k; b++)
                hat[12 * a + i] += t->C[a * t->k + b] * x[12 * (b + 1) + i];
        }
    for (int i = 0; t->second && i < 12; i++) mix[i] += t->gamma * x[12 * (t->k + 1) + i];
}

// What tss__jet_run does, of one stencil; m numbers a column.
static void tss__shell_jet(tss__n_jet *t, int s, int m, const double *x, double *hat, double *bar) {
    tss__hd g[12];
    double mix[12];
    int k = t->k, tangent = t->mode == TSS__CELL_TANGENT;
    tss__shell_mix(t, x, hat, mix);
    t->P += tss__shell_stencil(t->e, s, x, mix, NULL, g);
    for (int i = 0; i < m; i++) {
        for (int a = 0; a < k; a++) {
            if (t->P1) t->P1[a] += g[i].v * x[12 * (a + 1) + i];
            bar[12 * (a + 1) + i] = t->beta ? t->beta[a] * g[i].v : 0;
        }
        if (t->second)
            t->P2 += g[i].v * x[12 * (k + 1) + i], bar[12 * (k + 1) + i] = t->gamma * g[i].v;
        bar[i] = tangent ? g[i].v : t->alpha * g[i].v + g[i].a;
    }
    for (int a = 0; a < k && (t->second || tangent); a++) {
        tss__shell_stencil(t->e, s, x, x + 12 * (a + 1), t->second ? hat + 12 * a : NULL, g);
        for (int i = 0; i < m; i++) {
            if (tangent) {
                bar[12 * (a + 1) + i] = g[i].a;
                continue;
            }
            t->P2 += g[i].a * hat[12 * a + i];
            bar[12 * (a + 1) + i] += 2 * t->gamma * g[i].b;
            bar[i] += t->gamma * g[i].ab;
        }
    }
}

// The same without directions: alpha P.
static void tss__shell_scaled(tss__n_jet *t) {
    for (int s = 0; s < t->e->cells + t->e->hinges; s++) {
        double x[12], g[12], f = t->mode == TSS__CELL_TANGENT ? 1 : t->alpha;
        int count;
        const int *v = tss__shell_nodes(t->e, t->cell, t->hinge, s, &count);
        tss__shell_gather(t->x, v, count, x);
        t->P += tss__plain_stencil(t->e, s, x, g);
        for (int i = 0; t->mode != TSS__CELL_VALUE && i < count; i++)
            for (int r = 0; r < 3; r++) t->bar[3 * v[i] + r] += f * g[3 * i + r];
    }
}

static void tss__shell_jets(tss__n_jet *t) {
    int cols = 1 + t->k + t->second, count;
    if (cols == 1) {
        tss__shell_scaled(t);
        return;
    }
    double *x = t->scratch, *hat = x + 12 * cols, *bar = hat + 12 * (t->k + 1);
    for (int s = 0; s < t->e->cells + t->e->hinges; s++) {
        const int *v = tss__shell_nodes(t->e, t->cell, t->hinge, s, &count);
        for (int c = 0; c < cols; c++)
            tss__shell_gather(t->x + (size_t)c * t->ld, v, count, x + 12 * c);
        tss__shell_jet(t, s, 3 * count, x, hat, bar);
        for (int c = 0; t->mode != TSS__CELL_VALUE && c < cols; c++)
            for (int i = 0; i < 3 * count; i++)
                t->bar[(size_t)c * t->ld + (size_t)(3 * v[i / 3] + i % 3)] += bar[12 * c + i];
    }
}

static void tss__jet_run(tss__n_jet *t) {
    int cols = 1 + t->k + t->second, d = t->e->dim;
    double *F = t->scratch, *hat = F + 9 * cols, *bar = hat + 9 * (t->k + 1);
    t->P = t->P2 = 0;
    if (t->P1) tss__n_zero(t->P1, (size_t)t->k);
    if (t->e->thick > 0) {
        tss__shell_jets(t);
        return;
    }
    for (int k = 0; k < t->e->cells; k++) {
        tss__n_cell q;
        double vol = t->e->vol[k];
        tss__jet_gather(t, k, cols, F);
        tss__cell_at(&q, d, t->e->mu[k], t->e->la[k], F);
        t->P += vol * q.psi;
        for (int a = 0; t->P1 && a < t->k; a++)
            t->P1[a] += vol * tss__dot_n(q.dd, q.P, F + 9 * (a + 1));
        if (t->second) t->P2 += vol * tss__jet_second(t, &q, F, hat);
        if (t->mode == TSS__CELL_VALUE) continue;
        if (t->mode == TSS__CELL_TANGENT)
            tss__jet_tangent(t, &q, F, bar);
        else
            tss__jet_reverse(t, &q, F, hat, bar);
        tss__jet_scatter(t, k, cols, bar);
    }
}

// ---- the gradient alone, eight cells at a time ------------------------------------------------

// Ψ and w·vol·P of eight cells from F; entry i of cell l at [i][l]. The same formulas as
// tss__cell_at, in loops that a compiler turns into vector instructions.
typedef struct tss__n_lanes {
    double F[9][8], Dinv[9][8], mu[8], la[8], vol[8], psi[8];
} tss__n_lanes;

static void tss__lanes3(tss__n_lanes *q) {
    for (int l = 0; l < 8; l++) {
        double a = q->F[0][l], b = q->F[1][l], c = q->F[2][l], d = q->F[3][l], e = q->F[4][l],
               f = q->F[5][l], g = q->F[6][l], h = q->F[7][l], i = q->F[8][l];
        double mu = q->mu[l], la = q->la[l], A = a - 1, E = e - 1, I = i - 1;
        double K0 = e * i - f * h, K1 = f * g - d * i, K2 = d * h - e * g;
        double K3 = c * h - b * i, K4 = a * i - c * g, K5 = b * g - a * h;
        double K6 = b * f - c * e, K7 = c * d - a * f, K8 = a * e - b * d;
        double two = A * E - b * d + A * I - c * g + E * I - f * h;
        double three = A * (E * I - f * h) - b * (d * I - f * g) + c * (d * h - E * g);
        double j0 = A + E + I + two + three;
        double gap0 = A * A + b * b + c * c + d * d + E * E + f * f + g * g + h * h + I * I -
                      2 * two - 2 * three;
        double xx = 2 * A + (A * A + d * d + g * g), yy = 2 * E + (b * b + E * E + h * h);
        double zz = 2 * I + (c * c + f * f + I * I), xy = b + d + (A * b + d * E + g * h);
        double xz = c + g + (A * c + d * f + g * I), yz = f + h + (b * c + E * f + h * I);
        double size = xx * xx + yy * yy + zz * zz + 2 * (xy * xy + xz * xz + yz * yz);
        two = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz;
        three = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
        int small = size <= TSS__N_SMALL && j0 > -1;
        double j1 = (xx + yy + zz + two + three) / (small ? 2 + j0 : 1);
        double j = small ? j1 : j0, gap = small ? j1 * j1 - two - three : gap0;
        double s = la * j - mu;
        q->psi[l] = 0.5 * (mu * gap + la * j * j);
        q->F[0][l] = mu * a + s * K0, q->F[1][l] = mu * b + s * K1, q->F[2][l] = mu * c + s * K2;
        q->F[3][l] = mu * d + s * K3, q->F[4][l] = mu * e + s * K4, q->F[5][l] = mu * f + s * K5;
        q->F[6][l] = mu * g + s * K6, q->F[7][l] = mu * h + s * K7, q->F[8][l] = mu * i + s * K8;
    }
}

static void tss__lanes2(tss__n_lanes *q) {
    for (int l = 0; l < 8; l++) {
        double a = q->F[0][l], b = q->F[1][l], c = q->F[2][l], d = q->F[3][l];
        double mu = q->mu[l], la = q->la[l], A = a - 1, D = d - 1, two = A * D - b * c;
        double j0 = A + D + two, gap0 = A * A + b * b + c * c + D * D - 2 * two;
        double xx = 2 * A + (A * A + c * c), yy = 2 * D + (b * b + D * D);
        double xy = b + c + (A * b + c * D);
        int small = xx * xx + yy * yy + 2 * xy * xy <= TSS__N_SMALL && j0 > -1;
        two = xx * yy - xy * xy;
        double j1 = (xx + yy + two) / (small ? 2 + j0 : 1);
        double j = small ? j1 : j0, gap = small ? j1 * j1 - two : gap0, s = la * j - mu;
        q->psi[l] = 0.5 * (mu * gap + la * j * j);
        q->F[0][l] = mu * a + s * d, q->F[1][l] = mu * b - s * c;
        q->F[2][l] = mu * c - s * b, q->F[3][l] = mu * d + s * a;
    }
}

// F of `count` <= 8 cells from cell k on; the other lanes are at rest. D and G below are 2 or 3 and
// known when this is compiled.
static inline void tss__lanes_gather(const tss_elements *e, const int *cell, int k, int count,
                                     const double *x, const int d, tss__n_lanes *q) {
    double edge[9][8];
    for (int l = 0; l < 8; l++) {
        int at = l < count ? k + l : k;
        const int *v = cell + at * (d + 1);
        const double *Dinv = e->Dinv + at * d * d;
        for (int r = 0; r < d; r++)
            for (int i = 0; i < d; i++) edge[r * d + i][l] = x[v[i + 1] * d + r] - x[v[0] * d + r];
        for (int i = 0; i < d * d; i++) q->Dinv[i][l] = Dinv[i];
        q->mu[l] = e->mu[at], q->la[l] = e->la[at], q->vol[l] = l < count ? e->vol[at] : 0;
    }
    for (int r = 0; r < d; r++)
        for (int m = 0; m < d; m++)
            for (int l = 0; l < 8; l++) {
                double s = 0;
                for (int i = 0; i < d; i++) s += edge[r * d + i][l] * q->Dinv[i * d + m][l];
                q->F[r * d + m][l] = s;
            }
}

static inline void tss__lanes_scatter(const int *cell, int k, int count, const int d,
                                      const tss__n_lanes *q, double *g) {
    double f[9][8];
    for (int r = 0; r < d; r++)
        for (int i = 0; i < d; i++)
            for (int l = 0; l < 8; l++) {
                double s = 0;
                for (int m = 0; m < d; m++) s += q->F[r * d + m][l] * q->Dinv[i * d + m][l];
                f[r * d + i][l] = q->vol[l] * s;
            }
    for (int l = 0; l < count; l++) {
        const int *v = cell + (k + l) * (d + 1);
        for (int r = 0; r < d; r++)
            for (int i = 0; i < d; i++)
                g[v[i + 1] * d + r] += f[r * d + i][l], g[v[0] * d + r] -= f[r * d + i][l];
    }
}

static double tss__lanes_run(const tss_elements *e, const int *cell, const double *x, double *g) {
    double P = 0;
    for (int k = 0; k < e->cells; k += 8) {
        tss__n_lanes q;
        int count = e->cells - k < 8 ? e->cells - k : 8;
        if (e->dim == 3)
            tss__lanes_gather(e, cell, k, count, x, 3, &q), tss__lanes3(&q);
        else
            tss__lanes_gather(e, cell, k, count, x, 2, &q), tss__lanes2(&q);
        for (int l = 0; l < count; l++) P += q.vol[l] * q.psi[l];
        if (g && e->dim == 3) tss__lanes_scatter(cell, k, count, 3, &q, g);
        if (g && e->dim == 2) tss__lanes_scatter(cell, k, count, 2, &q, g);
    }
    return P;
}

// P at x; its gradient is added to g (NULL: not wanted). Nodes are numbered as in cell and hinge.
static double tss__elements_gradient(const tss_elements *e, const int *cell, const int *hinge,
                                     const double *x, double *g) {
    return e->thick > 0 ? tss__shell_run(e, cell, hinge, x, g) : tss__lanes_run(e, cell, x, g);
}

double tss_elements_potential(const tss_elements *e, const double *x, double *g) {
    return tss__elements_gradient(e, e->cell, e->hinge, x, g);
}

tss_result tss_elements_jets(const tss_elements *e, int k, const double *x, const double *x1,
                             const double *C, const double *x2, double *P, double *P1, double *P2,
                             double alpha, const double *beta, double gamma, double *x_bar,
                             double *x1_bar, double *x2_bar) {
    if (!tss__n_sizes(1, k) || (k > 0 && !x1) || !C != !x2 || (C && k == 0))
        return TSS_ERROR_BAD_ARGUMENT;
    size_t n = (size_t)(e->nodes * e->dim), wide = n * sizeof(double), K = (size_t)k;
    size_t cols = 1 + K + (C != NULL), count = 2 * cols * n + TSS__N_CELL * (3 * cols + 2);
    double *p = (double *)tss_alloc(&e->host, count * sizeof(double));
    if (!p) return TSS_ERROR_NO_MEMORY;
    tss__n_zero(p, count);
    tss__n_jet t;
    memset(&t, 0, sizeof t);
    t.e = e, t.cell = e->cell, t.hinge = e->hinge, t.mode = TSS__CELL_REVERSE, t.k = k,
    t.second = C != NULL, t.x = p, t.ld = n;
    t.C = C, t.alpha = alpha, t.beta = beta, t.gamma = gamma, t.bar = p + cols * n, t.P1 = P1;
    t.scratch = t.bar + cols * n;
    memcpy(p, x, wide);
    if (k) memcpy(p + n, x1, K * wide);
    if (C) memcpy(p + (1 + K) * n, x2, wide);
    tss__jet_run(&t);
    if (P) *P = t.P;
    if (P2) *P2 = t.P2;
    for (size_t i = 0; x_bar && i < n; i++) x_bar[i] += t.bar[i];
    for (size_t i = 0; x1_bar && i < K * n; i++) x1_bar[i] += t.bar[n + i];
    for (size_t i = 0; x2_bar && C && i < n; i++) x2_bar[i] += t.bar[(1 + K) * n + i];
    tss_free(&e->host, p, count * sizeof(double));
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>reduced (private)
// One job serves all that is asked of P(f(z)): values, reverse passes with seeds, and Hessians
// times directions (the tangent of the reverse pass). Only the coordinates that elements touch are
// made.
// ---------------------------------------------------------------------------------------------

typedef struct tss__n_reduced {
    tss__jetpass p;
    const tss_elements *e;
    int mode;
    const double *z, *D;
    size_t stride;                  // of D from sample to sample
    const double *alpha;            // batch, or NULL: all_alpha
    double all_alpha, beta, gamma;  // beta: of each direction
    double *betas;                  // k times beta
    double *P, *P2;                 // batch, or NULL
    double *gradient;  // batch × r: of the seeded sum in z (TANGENT: ∇P); overwritten; or NULL
    double *HD;        // TANGENT: batch × k × r, or NULL
    double *cell_scratch;
    const tss_held *held;  // or NULL
} tss__n_reduced;

// The column of a coordinate where only those that elements touch are made; -1: not among them.
static int tss__reduced_column(const tss_elements *e, int coordinate) {
    int lo = 0, hi = e->used * e->dim;
    while (lo < hi) {
        int mid = (lo + hi) / 2;
        if (e->dof[mid] < coordinate)
            lo = mid + 1;
        else
            hi = mid;
    }
    return lo < e->used * e->dim && e->dof[lo] == coordinate ? lo : -1;
}

// Columns of a sample's rows that are held: value to the first row (NULL: 0), 0 to the others.
static void tss__reduced_pin(const tss__n_reduced *j, double *rows, const double *value) {
    const tss__jetpass *p = &j->p;
    for (int h = 0; j->held && h < j->held->count; h++) {
        int at = j->held->index[h];
        if (p->dof) at = tss__reduced_column(j->e, at);
        if (at < 0) continue;
        for (size_t a = 0; a < (size_t)p->cols; a++)
            rows[a * p->coords + (size_t)at] = value && a == 0 ? value[h] : 0;
    }
}

static int tss__held_fits(const tss_held *h, const tss_net *n) {
    for (int k = 0; h && k < h->count; k++)
        if (h->index[k] < 0 || h->index[k] >= n->outputs) return 0;
    return !h || (h->count >= 0 && (h->count == 0 || h->value));
}

static int tss__n_fits(const tss_net *n, const tss_elements *e) {
    return !n->has_in && n->outputs == e->nodes * e->dim;
}

static void tss__reduced_init(tss__n_reduced *j, const tss_net *n, const tss_elements *e, int mode,
                              int batch, int k, const double *C) {
    memset(j, 0, sizeof *j);
    int all = e->used == e->nodes;
    j->p = tss__jetpass_of(n, batch, k, C, all ? NULL : e->dof, e->used * e->dim);
    j->e = e, j->mode = mode, j->all_alpha = 1;
}

static void tss__reduced_plan(tss__n_reduced *j, tss__n_slab *s, int theta) {
    int reverse = j->mode != TSS__CELL_VALUE;
    tss__jetpass_plan(&j->p, s,
                      TSS__PASS_X | (reverse ? TSS__PASS_XBAR : 0) | (theta ? TSS__PASS_THETA : 0));
    j->cell_scratch = tss__n_take(s, j->p.chunks, (size_t)(3 * j->p.cols + 2) * TSS__N_CELL);
    j->betas = tss__n_take(s, 1, (size_t)j->p.k);
}

static void tss__reduced_elements(tss__n_reduced *j, int c) {
    const tss__jetpass *p = &j->p;
    int first = tss__jetpass_sample(p, c), count = tss__jetpass_samples(p, c);
    if (j->mode != TSS__CELL_VALUE)
        tss__n_zero(tss__jetpass_xbar(p, c), tss__jetpass_rows(p, c) * p->coords);
    for (int i = first; i < first + count; i++) {
        size_t row = (size_t)i * (size_t)p->cols * p->coords;
        tss__n_jet t;
        memset(&t, 0, sizeof t);
        t.e = j->e, t.cell = p->dof ? j->e->local : j->e->cell, t.mode = j->mode, t.k = p->k;
        t.hinge = p->dof ? j->e->hinge_local : j->e->hinge;
        t.second = p->second, t.x = p->x + row, t.ld = p->coords;
        t.C = p->second ? p->C + (size_t)i * (size_t)(p->k * p->k) : NULL;
        t.alpha = j->alpha ? j->alpha[i] : j->all_alpha, t.beta = j->betas, t.gamma = j->gamma;
        t.bar = j->mode != TSS__CELL_VALUE ? p->xbar + row : NULL;
        t.scratch = j->cell_scratch + (size_t)c * (size_t)(3 * p->cols + 2) * TSS__N_CELL;
        const double *held = j->held ? j->held->value + (size_t)i * (size_t)j->held->count : NULL;
        tss__reduced_pin(j, p->x + row, held);
        tss__jet_run(&t);
        if (t.bar) tss__reduced_pin(j, t.bar, NULL);
        if (j->P) j->P[i] = t.P;
        if (j->P2) j->P2[i] = t.P2;
    }
}

static void tss__reduced_task(int c, int worker, void *arg) {
    (void)worker;
    tss__n_reduced *j = (tss__n_reduced *)arg;
    const tss__jetpass *p = &j->p;
    size_t r = (size_t)p->net->width[0], k = (size_t)p->k, wide = r * sizeof(double);
    tss__jetpass_load(p, c, j->z, j->D, j->stride);
    tss__jetpass_forward(p, c);
    tss__jetpass_out(p, c);
    tss__reduced_elements(j, c);
    if (j->mode == TSS__CELL_VALUE) return;
    tss__jetpass_in_bar(p, c, tss__jetpass_xbar(p, c));
    const double *bar = tss__jetpass_backward(p, c, j->mode == TSS__CELL_TANGENT);
    int first = tss__jetpass_sample(p, c), count = tss__jetpass_samples(p, c);
    for (int i = 0; i < count; i++, bar += (size_t)p->cols * r) {
        size_t s = (size_t)(first + i);
        if (j->gradient) memcpy(j->gradient + s * r, bar, wide);
        if (j->HD) memcpy(j->HD + s * k * r, bar + r, k * wide);
    }
}

static void tss__reduced_run(tss__n_reduced *j, tss_work *w) {
    for (int a = 0; a < j->p.k; a++) j->betas[a] = j->beta;
    tss_parallel(&w->host, j->p.chunks, tss__reduced_task, j);
}

static void tss__n_identity(double *D, int r) {
    tss__n_zero(D, (size_t)(r * r));
    for (int a = 0; a < r; a++) D[a * r + a] = 1;
}

static tss_result tss__reduced_potential(const tss_net *n, const tss_elements *e, tss_work *w,
                                         const tss_held *held, int batch, const double *z,
                                         double *P, double *gradient, double *hessian) {
    if (!tss__n_sizes(batch, hessian ? n->width[0] : 0) || !tss__n_fits(n, e))
        return TSS_ERROR_BAD_ARGUMENT;
    tss__n_reduced j;
    tss__n_slab s = {NULL, 0, 0};
    int r = n->width[0], k = hessian ? r : 0;
    double *D = NULL;
    tss__reduced_init(&j, n, e,
                      hessian    ? TSS__CELL_TANGENT
                      : gradient ? TSS__CELL_REVERSE
                                 : TSS__CELL_VALUE,
                      batch, k, NULL);
    for (int pass = 0; pass < 2; pass++) {
        tss__reduced_plan(&j, &s, 0);
        D = tss__n_take(&s, k, (size_t)r);
        if (pass == 0 && !tss__n_room(w, &s)) return TSS_ERROR_NO_MEMORY;
    }
    if (hessian) tss__n_identity(D, r);
    j.z = z, j.D = D, j.P = P, j.gradient = gradient, j.HD = hessian, j.held = held;
    tss__reduced_run(&j, w);
    return TSS_OK;
}

tss_result tss_reduced_potential(const tss_net *n, const tss_elements *e, tss_work *w, int batch,
                                 const double *z, double *P, double *gradient, double *hessian) {
    return tss__reduced_potential(n, e, w, NULL, batch, z, P, gradient, hessian);
}

tss_result tss_reduced_potential_held(const tss_net *n, const tss_elements *e, tss_work *w,
                                      const tss_held *held, int batch, const double *z, double *P,
                                      double *gradient, double *hessian) {
    if (!tss__held_fits(held, n)) return TSS_ERROR_BAD_ARGUMENT;
    return tss__reduced_potential(n, e, w, held, batch, z, P, gradient, hessian);
}

tss_result tss_reduced_second(const tss_net *n, const tss_elements *e, tss_work *w, int batch,
                              const double *z, const double *u, const double *v, double *out) {
    if (!tss__n_sizes(batch, 2) || !tss__n_fits(n, e)) return TSS_ERROR_BAD_ARGUMENT;
    tss__n_reduced j;
    tss__n_slab s = {NULL, 0, 0};
    size_t r = (size_t)n->width[0], B = (size_t)batch;
    double *D = NULL, *C = NULL, dummy = 0;
    tss__reduced_init(&j, n, e, TSS__CELL_VALUE, batch, 2, &dummy);
    for (int pass = 0; pass < 2; pass++) {
        tss__reduced_plan(&j, &s, 0);
        D = tss__n_take(&s, batch, 2 * r), C = tss__n_take(&s, batch, 4);
        if (pass == 0 && !tss__n_room(w, &s)) return TSS_ERROR_NO_MEMORY;
    }
    for (size_t i = 0; i < B; i++) {
        memcpy(D + 2 * r * i, u + r * i, r * sizeof(double));
        memcpy(D + 2 * r * i + r, v + r * i, r * sizeof(double));
        C[4 * i] = C[4 * i + 3] = 0, C[4 * i + 1] = C[4 * i + 2] = 0.5;
    }
    j.z = z, j.D = D, j.stride = 2 * r, j.p.C = C, j.P2 = out;
    tss__reduced_run(&j, w);
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>losses (private)
// ---------------------------------------------------------------------------------------------

static double tss__n_mean(const double *a, int count) {
    double s = 0;
    for (int i = 0; i < count; i++) s += a[i];
    return s / count;
}

typedef struct tss__n_recon {
    tss__jetpass enc, dec;
    const double *x, *mass;
    double *loss;  // of each sample
} tss__n_recon;

static void tss__recon_task(int c, int worker, void *arg) {
    (void)worker;
    tss__n_recon *j = (tss__n_recon *)arg;
    const tss__jetpass *e = &j->enc, *d = &j->dec;
    size_t n = d->coords;
    tss__jetpass_load(e, c, j->x, NULL, 0), tss__jetpass_forward(e, c), tss__jetpass_out(e, c);
    tss__jetpass_load(d, c, e->x, NULL, 0), tss__jetpass_forward(d, c), tss__jetpass_out(d, c);
    int first = tss__jetpass_sample(d, c), count = tss__jetpass_samples(d, c);
    for (int s = first; s < first + count; s++) {
        double sum = 0;
        for (size_t i = 0; i < n; i++) {
            double m = j->mass ? j->mass[i] : 1,
                   gap = d->x[(size_t)s * n + i] - j->x[(size_t)s * n + i];
            sum += m * gap * gap;
            d->xbar[(size_t)s * n + i] = 2 * m * gap / d->batch;
        }
        j->loss[s] = sum;
    }
    if (!d->theta && !e->theta) return;
    tss__jetpass_in_bar(d, c, tss__jetpass_xbar(d, c));
    const double *zbar = tss__jetpass_backward(d, c, 0);
    if (!e->theta) return;
    tss__jetpass_in_bar(e, c, zbar);
    tss__jetpass_backward(e, c, 0);
}

tss_result tss_loss_reconstruction(const tss_net *dec, const tss_net *enc, tss_work *w,
                                   const double *mass, int batch, const double *x, double weight,
                                   double *loss, double *decoder_bar, double *encoder_bar) {
    if (!tss__n_sizes(batch, 0) || dec->has_in || enc->outputs != dec->inputs ||
        enc->inputs != dec->outputs)
        return TSS_ERROR_BAD_ARGUMENT;
    tss__n_recon j;
    tss__n_slab s = {NULL, 0, 0};
    j.enc = tss__jetpass_of(enc, batch, 0, NULL, NULL, 0);
    j.dec = tss__jetpass_of(dec, batch, 0, NULL, NULL, 0);
    for (int pass = 0; pass < 2; pass++) {
        tss__jetpass_plan(&j.enc, &s, TSS__PASS_X | (encoder_bar ? TSS__PASS_THETA : 0));
        tss__jetpass_plan(&j.dec, &s,
                          TSS__PASS_X | TSS__PASS_XBAR | (decoder_bar ? TSS__PASS_THETA : 0));
        j.loss = tss__n_take(&s, batch, 1);
        if (pass == 0 && !tss__n_room(w, &s)) return TSS_ERROR_NO_MEMORY;
    }
    j.x = x, j.mass = mass;
    tss_parallel(&w->host, j.dec.chunks, tss__recon_task, &j);
    if (loss) *loss = tss__n_mean(j.loss, batch);
    tss__jetpass_collect(&w->host, &j.dec, weight, decoder_bar);
    tss__jetpass_collect(&w->host, &j.enc, weight, encoder_bar);
    return TSS_OK;
}

// ---- unsupervised ---------------------------------------------------------------------------

typedef struct tss__n_unsup {
    tss__n_reduced r;
    const double *mass;
    double lambda, sigma2, eps;
    const double *n;        // batch × r: whose distances the repulsion compares with
    double *P, *repulsion;  // of each sample
} tss__n_unsup;

static void tss__unsup_forward_task(int c, int worker, void *arg) {
    (void)worker;
    tss__n_unsup *j = (tss__n_unsup *)arg;
    tss__jetpass_load(&j->r.p, c, j->r.z, NULL, 0);
    tss__jetpass_forward(&j->r.p, c);
    tss__jetpass_out(&j->r.p, c);
    tss__reduced_elements(&j->r, c);
}

// Sample i against all others: q = ½ ln((‖Δf‖² + eps) / (σ²‖Δz‖² + eps)), mean of q² and its force.
static void tss__unsup_pair_task(int i, int worker, void *arg) {
    (void)worker;
    tss__n_unsup *j = (tss__n_unsup *)arg;
    const tss__jetpass *p = &j->r.p;
    size_t n = p->coords, r = (size_t)p->net->width[0];
    const double *xi = p->x + (size_t)i * n, *zi = j->n + (size_t)i * r;
    double *bar = p->xbar + (size_t)i * n, sum = 0;
    double share = 4 * j->lambda / ((double)p->batch * (p->batch - 1));
    for (int o = 0; o < p->batch; o++) {
        const double *xo = p->x + (size_t)o * n, *zo = j->n + (size_t)o * r;
        double df = 0, dz = 0;
        if (o == i) continue;
        for (size_t a = 0; a < n; a++)
            df += (j->mass ? j->mass[a] : 1) * (xi[a] - xo[a]) * (xi[a] - xo[a]);
        for (size_t a = 0; a < r; a++) dz += (zi[a] - zo[a]) * (zi[a] - zo[a]);
        double q = 0.5 * (log(df + j->eps) - log(j->sigma2 * dz + j->eps));
        double f = share * q / (df + j->eps);
        sum += q * q;
        for (size_t a = 0; a < n; a++) bar[a] += f * (j->mass ? j->mass[a] : 1) * (xi[a] - xo[a]);
    }
    j->repulsion[i] = sum / (p->batch - 1);
}

static void tss__unsup_backward_task(int c, int worker, void *arg) {
    (void)worker;
    const tss__jetpass *p = &((tss__n_unsup *)arg)->r.p;
    tss__jetpass_in_bar(p, c, tss__jetpass_xbar(p, c));
    tss__jetpass_backward(p, c, 0);
}

static tss_result tss__unsupervised(const tss_net *dec, const tss_elements *e, tss_work *w,
                                    const double *mass, double lambda, double sigma, double eps,
                                    int batch, const double *z, const double *normal, double weight,
                                    double *loss, double *parts, double *decoder_bar) {
    if (batch < 2 || !tss__n_sizes(batch, 0) || !tss__n_fits(dec, e) || !(sigma > 0) || !(eps >= 0))
        return TSS_ERROR_BAD_ARGUMENT;
    tss__n_unsup j;
    tss__n_slab s = {NULL, 0, 0};
    tss__reduced_init(&j.r, dec, e, TSS__CELL_REVERSE, batch, 0, NULL);
    // All coordinates: the distances of the repulsion need them.
    j.r.p.dof = NULL, j.r.p.coords = (size_t)dec->outputs;
    for (int pass = 0; pass < 2; pass++) {
        tss__reduced_plan(&j.r, &s, decoder_bar != NULL);
        j.P = tss__n_take(&s, batch, 1), j.repulsion = tss__n_take(&s, batch, 1);
        if (pass == 0 && !tss__n_room(w, &s)) return TSS_ERROR_NO_MEMORY;
    }
    j.r.z = z, j.n = normal, j.r.P = j.P, j.r.all_alpha = 1.0 / batch;
    j.mass = mass, j.lambda = lambda, j.sigma2 = sigma * sigma, j.eps = eps;
    tss_parallel(&w->host, j.r.p.chunks, tss__unsup_forward_task, &j);
    tss_parallel(&w->host, batch, tss__unsup_pair_task, &j);
    double potential = tss__n_mean(j.P, batch), repulsion = tss__n_mean(j.repulsion, batch);
    if (loss) *loss = potential + lambda * repulsion;
    if (parts) parts[0] = potential, parts[1] = repulsion;
    if (!decoder_bar) return TSS_OK;
    tss_parallel(&w->host, j.r.p.chunks, tss__unsup_backward_task, &j);
    tss__jetpass_collect(&w->host, &j.r.p, weight, decoder_bar);
    return TSS_OK;
}

tss_result tss_loss_unsupervised(const tss_net *dec, const tss_elements *e, tss_work *w,
                                 const double *mass, double lambda, double sigma, double eps,
                                 int batch, const double *z, double weight, double *loss,
                                 double *parts, double *decoder_bar) {
    return tss__unsupervised(dec, e, w, mass, lambda, sigma, eps, batch, z, z, weight, loss, parts,
                             decoder_bar);
}

// ---------------------------------------------------------------------------------------------
// >>lipschitz (private)
// Every variant is the mean over pairs of ‖φ_i − φ_j‖² / ‖z_i − z_j‖² for some features φ of a
// sample:
//     order 0: P;  1: ∇P;  2: ∇²P;  UV: uᵀ∇²P v;  U: ∇²P u   (probes: side by side, divided by
//     √probes)
// A first pass gives φ; pairs give φ̄; a second pass gives the gradient of ⟨φ̄, φ⟩ for fixed φ̄. That
// is one jet: α = φ̄;  D = φ̄, β = 1;  D = I, C = φ̄;  D = (u, w), C = [0 ½; ½ 0], w = φ̄ v or φ̄.
// ---------------------------------------------------------------------------------------------

tss_lipschitz_def tss_lipschitz_def_default(void) {
    tss_lipschitz_def d;
    memset(&d, 0, sizeof d);
    d.order = 2, d.probes = 1, d.floor = 1e-12;
    return d;
}

typedef struct tss__n_lip {
    tss_lipschitz_def def;
    int batch, r, m, k;  // features; directions of the second pass
    tss__n_reduced first, second;
    const double *z, *probe;
    double *phi, *bar;  // batch × m
    double *zbar;       // batch × r, of the distances
    double *zjet;       // batch × r, of the features
    double *loss;       // batch
    double *HD, *D1, *D, *C;
} tss__n_lip;

static int tss__lip_random(const tss__n_lip *l) { return l->def.estimator != TSS_LIPSCHITZ_EXACT; }

static void tss__lip_init(tss__n_lip *l, const tss_net *n, const tss_elements *e,
                          const tss_lipschitz_def *def, int batch) {
    static const double marker = 0;  // "there is a C": set before the run
    int r = n->width[0], order = def->order, random = def->estimator != TSS_LIPSCHITZ_EXACT;
    memset(l, 0, sizeof *l);
    l->def = *def, l->batch = batch, l->r = r;
    int k1 = order < 2 ? 0 : random ? def->probes : r;
    l->m = order == 0 ? 1 : order == 1 ? r : def->estimator == TSS_LIPSCHITZ_UV ? k1 : k1 * r;
    // Once the probes' vectors are as many as r, the coordinates serve as well.
    l->k = order < 2 ? order : random && 2 * k1 < r ? 2 * k1 : r;
    tss__reduced_init(&l->first, n, e,
                      order == 0   ? TSS__CELL_VALUE
                      : order == 1 ? TSS__CELL_REVERSE
                                   : TSS__CELL_TANGENT,
                      batch, k1, NULL);
    tss__reduced_init(&l->second, n, e, TSS__CELL_REVERSE, batch, l->k,
                      order == 2 ? &marker : NULL);
    l->first.held = l->second.held = def->held;
}

static void tss__lip_plan(tss__n_lip *l, tss__n_slab *s, int reverse, int theta) {
    size_t r = (size_t)l->r, k = (size_t)l->k, m = (size_t)l->m;
    tss__reduced_plan(&l->first, s, 0);
    l->phi = tss__n_take(s, l->batch, m);
    l->HD = tss__n_take(s, l->batch, (size_t)l->first.p.k * r);
    l->D1 = tss__n_take(s, l->first.p.k, r);
    l->loss = tss__n_take(s, l->batch, 1);
    if (!reverse) return;
    tss__reduced_plan(&l->second, s, theta);
    l->bar = tss__n_take(s, l->batch, m);
    l->zbar = tss__n_take(s, l->batch, r), l->zjet = tss__n_take(s, l->batch, r);
    l->D = tss__n_take(s, l->batch, k * r), l->C = tss__n_take(s, l->batch, k * k);
}

static void tss__lip_features(tss__n_lip *l, tss_work *w) {
    size_t r = (size_t)l->r, K = (size_t)l->first.p.k, B = (size_t)l->batch;
    tss__n_reduced *j = &l->first;
    j->z = l->z, j->D = l->D1;
    if (l->def.order == 0) j->P = l->phi;
    if (l->def.order == 1) j->gradient = l->phi;
    if (l->def.order == 2) j->HD = l->HD;
    if (l->def.order == 2 && !tss__lip_random(l)) tss__n_identity(l->D1, l->r);
    for (size_t k = 0; tss__lip_random(l) && k < K; k++)
        memcpy(l->D1 + k * r, l->probe + 2 * k * r, r * sizeof(double));
    tss__reduced_run(j, w);
    if (l->def.order < 2) return;
    double share = tss__lip_random(l) ? 1 / sqrt((double)K) : 1;
    for (size_t i = 0; i < B * K; i++) {
        const double *Hu = l->HD + i * r;
        if (l->def.estimator == TSS_LIPSCHITZ_UV)
            l->phi[i] = share * tss__dot_n(l->r, Hu, l->probe + (2 * (i % K) + 1) * r);
        else
            for (size_t a = 0; a < r; a++) l->phi[i * r + a] = share * Hu[a];
    }
}

static double tss__n_gap(const double *a, const double *b, size_t n) {
    double s = 0;
    for (size_t i = 0; i < n; i++) s += (a[i] - b[i]) * (a[i] - b[i]);
    return s;
}

static void tss__lip_pair_task(int i, int worker, void *arg) {
    (void)worker;
    tss__n_lip *l = (tss__n_lip *)arg;
    size_t m = (size_t)l->m, r = (size_t)l->r, at = (size_t)i;
    const double *fi = l->phi + at * m, *zi = l->z + at * r;
    double share = 4 / ((double)l->batch * (l->batch - 1)), sum = 0;
    if (l->bar) tss__n_zero(l->bar + at * m, m), tss__n_zero(l->zbar + at * r, r);
    for (size_t o = 0; o < (size_t)l->batch; o++) {
        const double *fo = l->phi + o * m, *zo = l->z + o * r;
        if (o == at) continue;
        double dz = l->def.undivided ? 1 : tss__n_gap(zi, zo, r), df = tss__n_gap(fi, fo, m);
        int floored = l->def.undivided || dz <= l->def.floor;
        if (floored && !l->def.undivided) dz = l->def.floor;
        if (dz == 0) continue;  // twice the same sample, and no floor
        sum += df / dz;
        if (!l->bar) continue;
        for (size_t a = 0; a < m; a++) l->bar[at * m + a] += share / dz * (fi[a] - fo[a]);
        for (size_t a = 0; !floored && a < r; a++)
            l->zbar[at * r + a] -= share * df / (dz * dz) * (zi[a] - zo[a]);
    }
    l->loss[i] = sum / (l->batch - 1);
}

// D and C of the second pass for sample i, order 2.
static void tss__lip_jet(tss__n_lip *l, size_t i) {
    size_t r = (size_t)l->r, k = (size_t)l->k, K = (size_t)l->first.p.k;
    double *D = l->D + i * k * r, *C = l->C + i * k * k;
    double share = 1 / sqrt((double)K);
    int direct = tss__lip_random(l) && k == 2 * K && k < r;
    tss__n_zero(C, k * k);
    if (!direct) tss__n_identity(D, l->r);
    for (size_t p = 0; p < K; p++) {
        if (!tss__lip_random(l)) {  // C = the symmetric part of φ̄
            for (size_t a = 0; a < r; a++) {
                double f = 0.5 * l->bar[i * (size_t)l->m + p * r + a];
                C[p * r + a] += f, C[a * r + p] += f;
            }
            continue;
        }
        const double *u = l->probe + 2 * p * r, *v = u + r, *w = v;
        double f = share;
        if (l->def.estimator == TSS_LIPSCHITZ_UV)
            f *= l->bar[i * K + p];
        else
            w = l->bar + (i * K + p) * r;
        if (direct) {
            memcpy(D + 2 * p * r, u, r * sizeof(double));
            for (size_t a = 0; a < r; a++) D[(2 * p + 1) * r + a] = f * w[a];
            C[2 * p * k + 2 * p + 1] = C[(2 * p + 1) * k + 2 * p] = 0.5;
        } else {
            for (size_t a = 0; a < r; a++)
                for (size_t b = 0; b < r; b++)
                    C[a * r + b] += 0.5 * f * (u[a] * w[b] + w[a] * u[b]);
        }
    }
}

static void tss__lip_reverse(tss__n_lip *l, tss_work *w) {
    tss__n_reduced *j = &l->second;
    j->z = l->z, j->gradient = l->zjet, j->all_alpha = 0;
    j->D = l->D, j->stride = (size_t)(l->k * l->r);
    if (l->def.order == 0) j->alpha = l->bar;
    if (l->def.order == 1) j->D = l->bar, j->beta = 1;
    if (l->def.order == 2) j->p.C = l->C, j->gamma = 1;
    for (size_t i = 0; l->def.order == 2 && i < (size_t)l->batch; i++) tss__lip_jet(l, i);
    tss__reduced_run(j, w);
}

static int tss__lip_valid(const tss_net *n, const tss_elements *e, const tss_lipschitz_def *d,
                          int batch, const double *probe) {
    int random = d->estimator != TSS_LIPSCHITZ_EXACT;
    return batch >= 2 && tss__n_sizes(batch, d->order == 2 ? n->width[0] : 2) &&
           tss__n_fits(n, e) && tss__held_fits(d->held, n) && d->order >= 0 && d->order <= 2 &&
           (unsigned)d->estimator <= TSS_LIPSCHITZ_U && d->floor >= 0 && d->floor < 1e300 &&
           (!random || (d->order == 2 && probe && d->probes >= 1 && d->probes <= n->width[0]));
}

tss_result tss_loss_lipschitz(const tss_net *dec, const tss_elements *e, tss_work *w,
                              const tss_lipschitz_def *def, int batch, const double *z,
                              const double *probe, double weight, double *loss, double *decoder_bar,
                              double *z_bar) {
    if (!tss__lip_valid(dec, e, def, batch, probe)) return TSS_ERROR_BAD_ARGUMENT;
    tss__n_lip l;
    tss__n_slab s = {NULL, 0, 0};
    int reverse = decoder_bar || z_bar;
    tss__lip_init(&l, dec, e, def, batch);
    for (int pass = 0; pass < 2; pass++) {
        tss__lip_plan(&l, &s, reverse, decoder_bar != NULL);
        if (pass == 0 && !tss__n_room(w, &s)) return TSS_ERROR_NO_MEMORY;
    }
    l.z = z, l.probe = probe;
    tss__lip_features(&l, w);
    tss_parallel(&w->host, batch, tss__lip_pair_task, &l);
    if (loss) *loss = tss__n_mean(l.loss, batch);
    if (!reverse) return TSS_OK;
    tss__lip_reverse(&l, w);
    tss__jetpass_collect(&w->host, &l.second.p, weight, decoder_bar);
    for (size_t i = 0; z_bar && i < (size_t)(batch * l.r); i++)
        z_bar[i] += weight * (l.zbar[i] + l.zjet[i]);
    return TSS_OK;
}

static void tss__lip_max_task(int i, int worker, void *arg) {
    (void)worker;
    tss__n_lip *l = (tss__n_lip *)arg;
    size_t m = (size_t)l->m, r = (size_t)l->r, at = (size_t)i;
    double most = 0;
    for (size_t o = at + 1; o < (size_t)l->batch; o++) {
        double dz = tss__n_gap(l->z + at * r, l->z + o * r, r);
        double f = dz == 0 ? 0 : tss__n_gap(l->phi + at * m, l->phi + o * m, m) / dz;
        most = f > most || isnan(f) ? f : most;
    }
    l->loss[i] = most;
}

tss_result tss_lipschitz_estimate(const tss_net *dec, const tss_elements *e, tss_work *w, int order,
                                  int batch, const double *z, double *out) {
    return tss_lipschitz_estimate_held(dec, e, w, order, NULL, batch, z, out);
}

tss_result tss_lipschitz_estimate_held(const tss_net *dec, const tss_elements *e, tss_work *w,
                                       int order, const tss_held *held, int batch, const double *z,
                                       double *out) {
    tss_lipschitz_def def = tss_lipschitz_def_default();
    def.order = order, def.held = held;
    if (!tss__lip_valid(dec, e, &def, batch, NULL)) return TSS_ERROR_BAD_ARGUMENT;
    tss__n_lip l;
    tss__n_slab s = {NULL, 0, 0};
    tss__lip_init(&l, dec, e, &def, batch);
    for (int pass = 0; pass < 2; pass++) {
        tss__lip_plan(&l, &s, 0, 0);
        if (pass == 0 && !tss__n_room(w, &s)) return TSS_ERROR_NO_MEMORY;
    }
    l.z = z;
    tss__lip_features(&l, w);
    tss_parallel(&w->host, batch, tss__lip_max_task, &l);
    double most = 0;
    for (int i = 0; i < batch; i++) most = l.loss[i] > most || isnan(l.loss[i]) ? l.loss[i] : most;
    *out = sqrt(most);
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>cubature (private)
// min ‖G w − b‖, w >= 0, with at most `count` weights: G has a column of samples · r numbers for
// each candidate. The normal equations of the chosen columns are kept with their Cholesky factor,
// which grows by a row a cell and is made anew when one leaves.
// ---------------------------------------------------------------------------------------------

tss_cubature_def tss_cubature_def_default(void) {
    tss_cubature_def d;
    memset(&d, 0, sizeof d);
    d.count = 300;
    return d;
}

typedef struct tss__cub {
    const tss_host *host;
    int candidates, most, chosen;
    size_t m;
    double *G, *norm, *b, *rest, *match;  // columns, their norms; b; b − G w; Gᵀ rest / norm
    double *A, *L, *rhs, *w, *s;          // most × most twice, then most each
    int *cell, *in;                       // of each candidate; candidates chosen
    uint8_t *out;                         // 1: chosen, or of no use
} tss__cub;

static void tss__cub_match_task(int block, int worker, void *arg) {
    (void)worker;
    tss__cub *c = (tss__cub *)arg;
    int end = 64 * (block + 1) < c->candidates ? 64 * (block + 1) : c->candidates;
    for (int k = 64 * block; k < end; k++)
        c->match[k] =
            c->out[k] ? 0 : tss__dot_n((int)c->m, c->G + (size_t)k * c->m, c->rest) / c->norm[k];
}

static void tss__cub_residual(tss__cub *c) {
    memcpy(c->rest, c->b, c->m * sizeof(double));
    for (int i = 0; i < c->chosen; i++) {
        const double *g = c->G + (size_t)c->in[i] * c->m;
        for (size_t k = 0; k < c->m; k++) c->rest[k] -= c->w[i] * g[k];
    }
}

// Row i of the factor, from row i of A. 0: the column depends on those before it.
static int tss__cub_factor_row(tss__cub *c, int i) {
    size_t ld = (size_t)c->most;
    double *row = c->L + (size_t)i * ld;
    const double *A = c->A + (size_t)i * ld;
    for (int j = 0; j <= i; j++) {
        const double *lj = c->L + (size_t)j * ld;
        double s = A[j] - tss__dot_n(j, row, lj);
        if (j < i)
            row[j] = s / lj[j];
        else if (!(s > 1e-10 * A[i]))
            return 0;
        else
            row[i] = sqrt(s);
    }
    return 1;
}

static int tss__cub_push(tss__cub *c, int candidate) {
    const double *g = c->G + (size_t)candidate * c->m;
    int i = c->chosen;
    c->in[i] = candidate, c->out[candidate] = 1;
    for (int j = 0; j <= i; j++)
        c->A[(size_t)i * (size_t)c->most + (size_t)j] =
            tss__dot_n((int)c->m, g, c->G + (size_t)c->in[j] * c->m);
    c->rhs[i] = tss__dot_n((int)c->m, g, c->b), c->w[i] = 0;
    if (!tss__cub_factor_row(c, i)) return 0;
    c->chosen++;
    return 1;
}

static void tss__cub_solve(tss__cub *c) {
    size_t ld = (size_t)c->most;
    for (int i = 0; i < c->chosen; i++)
        c->s[i] = (c->rhs[i] - tss__dot_n(i, c->L + (size_t)i * ld, c->s)) /
                  c->L[(size_t)i * ld + (size_t)i];
    for (int i = c->chosen - 1; i >= 0; i--) {
        double s = c->s[i];
        for (int j = i + 1; j < c->chosen; j++) s -= c->L[(size_t)j * ld + (size_t)i] * c->s[j];
        c->s[i] = s / c->L[(size_t)i * ld + (size_t)i];
    }
}

// Takes out the cells whose weight has reached 0.
static void tss__cub_drop(tss__cub *c) {
    size_t ld = (size_t)c->most;
    int to = 0;
    for (int i = 0; i < c->chosen; i++) {
        if (!(c->w[i] > 0)) {
            c->out[c->in[i]] = 0;
            continue;
        }
        // Rows and columns move up; what is read lies behind what is written.
        for (int j = 0, at = 0; j <= i; j++) {
            if (!(c->w[j] > 0)) continue;
            c->A[(size_t)to * ld + (size_t)at++] = c->A[(size_t)i * ld + (size_t)j];
        }
        to++;
    }
    for (int i = 0, at = 0; i < c->chosen; i++)
        if (c->w[i] > 0) c->in[at] = c->in[i], c->rhs[at] = c->rhs[i], c->w[at++] = c->w[i];
    c->chosen = to;
    for (int i = 0; i < to; i++) tss__cub_factor_row(c, i);
}

// Moves w to the least-squares weights as far as none turns negative, until they are reached.
static void tss__cub_weights(tss__cub *c) {
    for (;;) {
        double t = 1;
        int block = -1;
        tss__cub_solve(c);
        for (int i = 0; i < c->chosen; i++)
            if (c->s[i] <= 0 && c->w[i] <= t * (c->w[i] - c->s[i]))
                t = c->w[i] > 0 ? c->w[i] / (c->w[i] - c->s[i]) : 0, block = i;
        for (int i = 0; i < c->chosen; i++) c->w[i] += t * (c->s[i] - c->w[i]);
        if (block < 0) return;
        c->w[block] = 0;
        tss__cub_drop(c);
    }
}

static double tss__cub_run(tss__cub *c, double tol) {
    double all = sqrt(tss__dot_n((int)c->m, c->b, c->b)), error = all > 0 ? 1 : 0;
    // A round may end with as many cells as before: the bound is for those.
    for (int round = 0; round < 4 * c->most && c->chosen < c->most && error > tol; round++) {
        int best = -1;
        tss_parallel(c->host, (c->candidates + 63) / 64, tss__cub_match_task, c);
        for (int k = 0; k < c->candidates; k++)
            if (c->match[k] > 1e-12 * all && (best < 0 || c->match[k] > c->match[best])) best = k;
        if (best < 0) break;                    // no cell would help: the optimum with w >= 0
        if (!tss__cub_push(c, best)) continue;  // depends on the others: never tried again
        tss__cub_weights(c);
        if (!c->out[best])
            c->out[best] = 1;  // left at once: rounding, and would come back for ever
        tss__cub_residual(c);
        error = sqrt(tss__dot_n((int)c->m, c->rest, c->rest)) / all;
    }
    return error;
}

typedef struct tss__cub_fill {  // one sample's rows of G
    tss__cub *c;
    const tss_elements *e;
    const double *x;  // f(z), then its r derivatives
    int r;
    size_t n, first;
    double scale;
} tss__cub_fill;

// The reduced gradient of a shell's cell: its own, and half of its hinges'.
static void tss__cub_fill_shell(const tss__cub_fill *f, int cell, double *to) {
    const tss_elements *e = f->e;
    for (int s = -1; s < (e->hinges ? 3 : 0); s++) {
        int share = s < 0 ? -1 : e->cell_hinge[3 * cell + s], count;
        if (s >= 0 && share < 0) continue;
        double x[12], g[12];
        const int *v =
            tss__shell_nodes(e, e->cell, e->hinge, s < 0 ? cell : e->cells + share / 2, &count);
        tss__shell_gather(f->x, v, count, x);
        if (s < 0)
            tss__plain_cell(e->Dinv + 4 * cell, e->vol[cell], e->mu[cell], e->la[cell], x, g);
        else
            tss__plain_hinge(e->hinge_weight[share], e->rest[share / 2], x, g);
        for (int a = 0; a < f->r; a++) {
            tss__shell_gather(f->x + (size_t)(a + 1) * f->n, v, count, x);
            for (int i = 0; i < 3 * count; i++) to[a] += f->scale * g[i] * x[i];
        }
    }
}

static void tss__cub_fill_task(int block, int worker, void *arg) {
    (void)worker;
    tss__cub_fill *f = (tss__cub_fill *)arg;
    tss__cub *c = f->c;
    const tss_elements *e = f->e;
    int end = 64 * (block + 1) < c->candidates ? 64 * (block + 1) : c->candidates;
    for (int k = 64 * block; k < end; k++) {
        double F[9];
        tss__n_cell q;
        tss__n_jet t;
        memset(&t, 0, sizeof t);
        int cell = c->cell[k];
        if (e->thick > 0) {
            double *to = c->G + (size_t)k * c->m + f->first;
            tss__n_zero(to, (size_t)f->r), tss__cub_fill_shell(f, cell, to);
            continue;
        }
        t.e = e, t.cell = e->cell, t.x = f->x, t.ld = f->n;
        tss__jet_gather(&t, cell, 1, F);
        tss__cell_at(&q, e->dim, e->mu[cell], e->la[cell], F);
        for (int a = 0; a < f->r; a++) {
            t.x = f->x + (size_t)(a + 1) * f->n;
            tss__jet_gather(&t, cell, 1, F);
            c->G[(size_t)k * c->m + f->first + (size_t)a] =
                f->scale * e->vol[cell] * tss__dot_n(q.dd, q.P, F);
        }
    }
}

// b, G and norms. x: (1 + r)·n doubles, D: r² of them.
static tss_result tss__cub_system(tss__cub *c, const tss_net *n, const tss_elements *e, tss_work *w,
                                  const tss_held *held, int samples, const double *z, double *x,
                                  double *D) {
    size_t r = (size_t)n->inputs, coords = (size_t)n->outputs;
    tss_result result = tss__reduced_potential(n, e, w, held, samples, z, NULL, c->b, NULL);
    tss__n_identity(D, (int)r);
    for (size_t t = 0; result == TSS_OK && t < (size_t)samples; t++) {
        double *b = c->b + t * r, size = sqrt(tss__dot_n((int)r, b, b));
        tss__cub_fill f = {c, e, x, (int)r, coords, t * r, size > 0 ? 1 / size : 0};
        for (size_t a = 0; a < r; a++) b[a] *= f.scale;
        result = tss_net_jets(n, w, 1, (int)r, z + t * r, D, NULL, x, x + coords, NULL);
        for (size_t h = 0; held && h < (size_t)held->count; h++)
            for (size_t a = 0; a <= r; a++)
                x[a * coords + (size_t)held->index[h]] =
                    a ? 0 : held->value[t * (size_t)held->count + h];
        if (result == TSS_OK)
            tss_parallel(&w->host, (c->candidates + 63) / 64, tss__cub_fill_task, &f);
    }
    for (int k = 0; result == TSS_OK && k < c->candidates; k++) {
        const double *g = c->G + (size_t)k * c->m;
        c->norm[k] = sqrt(tss__dot_n((int)c->m, g, g));
        c->out[k] = !(c->norm[k] > 0);
    }
    memcpy(c->rest, c->b, c->m * sizeof(double));
    return result;
}

// Draws the candidates: the head of a shuffle, in ascending order so that all cells need no
// shuffle.
static void tss__cub_draw(tss__cub *c, const tss_elements *e, uint64_t seed) {
    tss_rng r = tss_rng_seed(seed);
    int left = c->candidates, at = 0;
    for (int k = 0; k < e->cells; k++)
        if (tss_rng_uniform(&r) * (e->cells - k) < left) c->cell[at++] = k, left--;
}

static void tss__cub_carve(tss__cub *c, tss__n_slab *s, size_t r, size_t coords, double **x,
                           double **D) {
    double most = c->most, all = c->candidates;
    c->G = tss__n_take(s, all, c->m), c->norm = tss__n_take(s, all, 1),
    c->match = tss__n_take(s, all, 1);
    c->b = tss__n_take(s, 1, c->m), c->rest = tss__n_take(s, 1, c->m);
    c->A = tss__n_take(s, most, (size_t)c->most), c->L = tss__n_take(s, most, (size_t)c->most);
    c->rhs = tss__n_take(s, most, 1), c->w = tss__n_take(s, most, 1),
    c->s = tss__n_take(s, most, 1);
    c->cell = (int *)(void *)tss__n_take(s, all, 1), c->in = (int *)(void *)tss__n_take(s, most, 1);
    c->out = (uint8_t *)(void *)tss__n_take(s, all, 1);
    *x = tss__n_take(s, (double)r + 1, coords), *D = tss__n_take(s, (double)r, r);
}

tss_result tss_cubature_select(const tss_net *n, const tss_elements *e, tss_work *w,
                               const tss_cubature_def *def, int samples, const double *z,
                               int *subset, double *weight, int *count, double *error) {
    *count = 0;
    if (!tss__n_fits(n, e) || samples < 1 || def->count < 1 || def->candidates < 0 ||
        !(def->tol >= 0) || !tss__held_fits(def->held, n) || !tss__n_sizes(samples, n->inputs) ||
        (double)samples * n->inputs > 1e9)
        return TSS_ERROR_BAD_ARGUMENT;
    tss__cub c;
    tss__n_slab s = {NULL, 0, 0};
    double *x, *D;
    size_t r = (size_t)n->inputs;
    memset(&c, 0, sizeof c);
    c.host = &w->host, c.m = (size_t)samples * r;
    c.candidates = def->candidates && def->candidates < e->cells ? def->candidates : e->cells;
    c.most = def->count < c.candidates ? def->count : c.candidates;
    tss__cub_carve(&c, &s, r, (size_t)n->outputs, &x, &D);
    if (s.want >= 1e15) return TSS_ERROR_NO_MEMORY;
    // Memory of its own: the scratch of w is used by what is called.
    size_t bytes = s.used * sizeof(double);
    s.base = (double *)tss_alloc(&w->host, bytes);
    if (!s.base) return TSS_ERROR_NO_MEMORY;
    double *block = s.base;
    s.used = 0, s.want = 0;
    tss__cub_carve(&c, &s, r, (size_t)n->outputs, &x, &D);
    tss__cub_draw(&c, e, def->seed);
    tss_result result = tss__cub_system(&c, n, e, w, def->held, samples, z, x, D);
    if (result == TSS_OK && !isfinite(tss__dot_n((int)c.m, c.b, c.b)))
        result = TSS_ERROR_BAD_ARGUMENT;
    if (result == TSS_OK) {
        double left = tss__cub_run(&c, def->tol);
        if (error) *error = left;
        for (int k = 0; k < c.candidates; k++) c.match[k] = 0;
        for (int i = 0; i < c.chosen; i++) c.match[c.in[i]] = c.w[i];
        for (int k = 0; k < c.candidates; k++)
            if (c.match[k] > 0) subset[*count] = c.cell[k], weight[(*count)++] = c.match[k];
    }
    tss_free(&w->host, block, bytes);
    return result;
}

// ---------------------------------------------------------------------------------------------
// >>adam (private)
// ---------------------------------------------------------------------------------------------

struct tss_adam {
    tss_host host;
    tss_adam_def def;
    uint64_t t;
    double power1, power2;  // beta1^(t+1), beta2^(t+1), by products: saved as they are
    size_t count;
    double *m, *v;  // one block
};

tss_adam_def tss_adam_def_default(void) {
    tss_adam_def d = {1e-3, 0.9, 0.999, 1e-8, 1, 0, 0};
    return d;
}

static int tss__adam_valid(const tss_adam_def *d) {
    return d->rate > 0 && d->rate < 1e300 && d->beta1 >= 0 && d->beta1 < 1 && d->beta2 >= 0 &&
           d->beta2 < 1 && d->eps > 0 && d->eps < 1e300 && d->decay > 0 && d->decay < 1e300;
}

static void tss__adam_restart(tss_adam *a) {
    tss__n_zero(a->m, 2 * a->count);
    a->t = 0, a->power1 = a->def.beta1, a->power2 = a->def.beta2;
}

tss_result tss_adam_create(const tss_host *host, const tss_adam_def *def, size_t parameters,
                           tss_adam **out) {
    tss_host h = host ? *host : tss_host_default();
    *out = NULL;
    if (!tss__adam_valid(def) || parameters < 1) return TSS_ERROR_BAD_ARGUMENT;
    if (parameters > (SIZE_MAX >> 5)) return TSS_ERROR_NO_MEMORY;
    tss_adam *a = (tss_adam *)tss_alloc(&h, sizeof *a);
    double *m = a ? (double *)tss_alloc(&h, 2 * parameters * sizeof(double)) : NULL;
    if (!m) {
        tss_free(&h, a, sizeof *a);
        return TSS_ERROR_NO_MEMORY;
    }
    a->host = h, a->def = *def, a->count = parameters, a->m = m, a->v = m + parameters;
    tss__adam_restart(a);
    *out = a;
    return TSS_OK;
}

void tss_adam_destroy(tss_adam *a) {
    if (!a) return;
    tss_host h = a->host;
    tss_free(&h, a->m, 2 * a->count * sizeof(double));
    tss_free(&h, a, sizeof *a);
}

double tss_adam_rate(const tss_adam *a) {
    double rate = a->def.rate;
    if (a->def.decay_every) rate *= pow(a->def.decay, (double)(a->t / a->def.decay_every));
    if (a->t < a->def.warmup) rate *= (double)(a->t + 1) / (double)a->def.warmup;
    return rate;
}

uint64_t tss_adam_steps(const tss_adam *a) { return a->t; }

void tss_adam_update(tss_adam *a, size_t first, size_t count, double *theta, const double *g) {
    TSS_ASSERT(first <= a->count && count <= a->count - first);
    double b1 = a->def.beta1, b2 = a->def.beta2, rate = tss_adam_rate(a);
    double c1 = 1 / (1 - a->power1), c2 = 1 / (1 - a->power2);
    double *m = a->m + first, *v = a->v + first;
    for (size_t i = 0; i < count; i++) {
        m[i] = b1 * m[i] + (1 - b1) * g[i];
        v[i] = b2 * v[i] + (1 - b2) * g[i] * g[i];
        theta[i] -= rate * (c1 * m[i]) / (sqrt(c2 * v[i]) + a->def.eps);
    }
}

void tss_adam_advance(tss_adam *a) { a->t++, a->power1 *= a->def.beta1, a->power2 *= a->def.beta2; }

tss_result tss_adam_set(tss_adam *a, const tss_adam_def *def, int restart) {
    if (!tss__adam_valid(def)) return TSS_ERROR_BAD_ARGUMENT;
    int same = def->beta1 == a->def.beta1 && def->beta2 == a->def.beta2;
    if (!same && !restart) return TSS_ERROR_BAD_ARGUMENT;  // moments of other betas mean nothing
    a->def = *def;
    if (restart) tss__adam_restart(a);
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>models (private)
// Everything is a 64-bit number, little-endian: integers and IEEE doubles. docs/neural.md has the
// table.
// ---------------------------------------------------------------------------------------------

#define TSS__MODEL_MAGIC 0x0A5255454E737374u  // "tssNEUR\n"
#define TSS__MODEL_VERSION 1u
#define TSS__MODEL_HEAD 4  // magic, version, bytes, checksum

typedef struct tss__n_out {  // p NULL: counting
    unsigned char *p;
    size_t at;
    int bad;  // a number was not finite
} tss__n_out;

static void tss__put(tss__n_out *o, uint64_t x) {
    for (int k = 0; o->p && k < 8; k++) o->p[o->at + (size_t)k] = (unsigned char)(x >> (8 * k));
    o->at += 8;
}

static void tss__put_doubles(tss__n_out *o, const double *x, size_t count) {
    for (size_t i = 0; i < count; i++) {
        uint64_t bits;
        memcpy(&bits, x + i, 8);
        tss__put(o, bits);
        o->bad |= !isfinite(x[i]);
    }
}

static uint64_t tss__get_at(const unsigned char *p) {
    uint64_t x = 0;
    for (int k = 0; k < 8; k++) x |= (uint64_t)p[k] << (8 * k);
    return x;
}

// FNV-1a of all bytes but the checksum itself: a change of one byte always changes it.
static uint64_t tss__model_sum(const unsigned char *p, size_t size) {
    uint64_t h = 14695981039346656037u;
    for (size_t i = 0; i < size; i++)
        if (i < 24 || i >= 32) h = (h ^ p[i]) * 1099511628211u;
    return h;
}

static void tss__put_net(tss__n_out *o, const tss_net *n) {
    size_t part[5], all = tss__net_parts(n, part);
    tss__put(o, (uint64_t)n->layers), tss__put(o, (uint64_t)n->activation);
    tss__put(o, (uint64_t)n->has_in), tss__put(o, (uint64_t)n->map);
    tss__put(o, (uint64_t)n->inputs), tss__put(o, (uint64_t)n->outputs);
    tss__put_doubles(o, &n->scale, 1);
    for (int l = 0; l <= n->layers; l++) tss__put(o, (uint64_t)n->width[l]);
    tss__put_doubles(o, n->p, all);
    for (int i = 0; n->from && i < n->outputs; i++) tss__put(o, (uint64_t)(n->from[i] + 1));
}

static void tss__put_adam(tss__n_out *o, const tss_adam *a) {
    const double d[7] = {a->def.rate,  a->def.beta1, a->def.beta2, a->def.eps,
                         a->def.decay, a->power1,    a->power2};
    tss__put_doubles(o, d, 7);
    tss__put(o, a->def.decay_every), tss__put(o, a->def.warmup), tss__put(o, a->t);
    tss__put(o, a->count);
    tss__put_doubles(o, a->m, 2 * a->count);
}

static size_t tss__put_model(const tss_model *m, unsigned char *data, uint64_t bytes) {
    tss__n_out o = {data, 0, 0};
    tss__put(&o, TSS__MODEL_MAGIC), tss__put(&o, TSS__MODEL_VERSION), tss__put(&o, bytes);
    tss__put(&o, 0);
    tss__put(&o, (m->encoder ? 1u : 0u) | (m->adam ? 2u : 0u));
    tss__put(&o, m->step);
    for (int k = 0; k < 4; k++) tss__put(&o, m->rng.s[k]);
    tss__put_net(&o, m->decoder);
    if (m->encoder) tss__put_net(&o, m->encoder);
    if (m->adam) tss__put_adam(&o, m->adam);
    return o.bad ? 0 : o.at;
}

size_t tss_model_save(const tss_model *m, void *data, size_t size) {
    if (!m->decoder) return 0;
    size_t need = tss__put_model(m, NULL, 0);
    if (!data) return need;
    if (!need || size < need) return 0;
    unsigned char *p = (unsigned char *)data;
    tss__put_model(m, p, need);
    tss__n_out at = {p, 24, 0};
    tss__put(&at, tss__model_sum(p, need));
    return need;
}

void tss_model_free(tss_model *m) {
    tss_net_destroy(m->decoder), tss_net_destroy(m->encoder), tss_adam_destroy(m->adam);
    memset(m, 0, sizeof *m);
}

typedef struct tss__n_in {
    const unsigned char *p;
    size_t at, size;
    tss_result result;  // the first error stays
    char *why;
    size_t why_size;
} tss__n_in;

static int tss__in_fail(tss__n_in *in, tss_result r, const char *text) {
    if (in->result == TSS_OK && in->why && in->why_size)
        snprintf(in->why, in->why_size, "%s (at byte %zu of %zu)", text, in->at, in->size);
    if (in->result == TSS_OK) in->result = r;
    return 0;
}

static uint64_t tss__get(tss__n_in *in) {
    if (in->size - in->at < 8) {
        tss__in_fail(in, TSS_ERROR_FORMAT, "the file ends too early");
        return 0;
    }
    in->at += 8;
    return tss__get_at(in->p + in->at - 8);
}

// A number that must lie in lo..hi.
static int tss__get_int(tss__n_in *in, uint64_t lo, uint64_t hi, const char *what) {
    uint64_t x = tss__get(in);
    char text[96];
    if (x >= lo && x <= hi) return (int)x;
    snprintf(text, sizeof text, "%s is %llu, outside %llu..%llu", what, (unsigned long long)x,
             (unsigned long long)lo, (unsigned long long)hi);
    tss__in_fail(in, TSS_ERROR_FORMAT, text);
    return (int)lo;
}

static int tss__get_doubles(tss__n_in *in, double *x, size_t count, const char *what) {
    char text[96];
    for (size_t i = 0; i < count; i++) {
        uint64_t bits = tss__get(in);
        memcpy(x + i, &bits, 8);
        if (isfinite(x[i])) continue;
        snprintf(text, sizeof text, "%s holds a number that is not finite", what);
        return tss__in_fail(in, TSS_ERROR_FORMAT, text);
    }
    return in->result == TSS_OK;
}

// Are there `count` more numbers?
static int tss__in_has(tss__n_in *in, double count, const char *what) {
    char text[96];
    if (count * 8 <= (double)(in->size - in->at)) return 1;
    snprintf(text, sizeof text, "%s needs %.0f numbers, more than the file has left", what, count);
    return tss__in_fail(in, TSS_ERROR_FORMAT, text);
}

static void tss__get_net_sizes(tss__n_in *in, tss_net *n) {
    n->layers = tss__get_int(in, 1, TSS__NET_LAYERS, "the number of layers");
    n->activation = (tss_activation)tss__get_int(in, 0, TSS_ACTIVATIONS - 1, "the activation");
    n->has_in = tss__get_int(in, 0, 1, "the flag of the first map");
    n->map = tss__get_int(in, 0, 2, "the kind of the last map");
    n->inputs = tss__get_int(in, 1, 1 << 28, "the number of inputs");
    n->outputs = tss__get_int(in, 1, 1 << 28, "the number of outputs");
    tss__get_doubles(in, &n->scale, 1, "the scale");
    for (int l = 0; l <= n->layers; l++) n->width[l] = tss__get_int(in, 1, 1 << 26, "a width");
    if (in->result != TSS_OK) return;
    if ((!n->has_in && n->inputs != n->width[0]) ||
        (n->map == TSS__MAP_NONE && n->outputs != n->width[n->layers]))
        tss__in_fail(in, TSS_ERROR_FORMAT, "inputs or outputs do not fit the widths");
}

// Numbers that a net of these sizes has in the file, in doubles: no overflow.
static double tss__net_numbers(const tss_net *n) {
    double s = 0, out = n->map ? n->outputs : 0, in = n->has_in ? n->inputs : 0;
    for (int l = 0; l < n->layers; l++) s += ((double)n->width[l] + 1) * n->width[l + 1];
    s += in * (1.0 + n->width[0]);
    return s + out * (n->map == TSS__MAP_MATRIX ? 1.0 + n->width[n->layers] : 2.0);
}

static tss_net *tss__get_net(tss__n_in *in, const tss_host *h, const char *name) {
    tss_net *n = (tss_net *)tss_alloc(h, sizeof *n);
    if (!n) {
        tss__in_fail(in, TSS_ERROR_NO_MEMORY, "no memory for a network");
        return NULL;
    }
    memset(n, 0, sizeof *n);
    n->host = *h;
    tss__get_net_sizes(in, n);
    if (in->result == TSS_OK && tss__in_has(in, tss__net_numbers(n), name)) {
        size_t part[5];
        tss__net_layout(n);
        if (!tss__net_arrays(n))
            tss__in_fail(in, TSS_ERROR_NO_MEMORY, "no memory for a network");
        else
            tss__get_doubles(in, n->p, tss__net_parts(n, part), name);
    }
    for (int i = 0; in->result == TSS_OK && n->from && i < n->outputs; i++)
        n->from[i] =
            tss__get_int(in, 0, (uint64_t)n->width[n->layers], "an output's coordinate") - 1;
    if (in->result == TSS_OK) return n;
    tss_net_destroy(n);
    return NULL;
}

static tss_adam *tss__get_adam(tss__n_in *in, const tss_host *h, size_t parameters) {
    tss_adam_def def;
    tss_adam *a = NULL;
    double d[7];
    uint64_t t, count;
    if (!tss__get_doubles(in, d, 7, "the optimiser")) return NULL;
    def.rate = d[0], def.beta1 = d[1], def.beta2 = d[2], def.eps = d[3], def.decay = d[4];
    def.decay_every = tss__get(in), def.warmup = tss__get(in), t = tss__get(in),
    count = tss__get(in);
    int powers = d[5] >= 0 && d[5] < 1 && d[6] >= 0 && d[6] < 1;
    if (!tss__adam_valid(&def) || !powers || count != parameters)
        tss__in_fail(in, TSS_ERROR_FORMAT, "the optimiser does not fit the networks");
    else if (tss__in_has(in, 2.0 * (double)count, "the optimiser") &&
             tss_adam_create(h, &def, parameters, &a) != TSS_OK)
        tss__in_fail(in, TSS_ERROR_NO_MEMORY, "no memory for the optimiser");
    if (!a) return NULL;
    a->t = t, a->power1 = d[5], a->power2 = d[6];
    tss__get_doubles(in, a->m, 2 * parameters, "the optimiser");
    for (size_t i = 0; i < parameters; i++)
        if (!(a->v[i] >= 0)) tss__in_fail(in, TSS_ERROR_FORMAT, "a second moment is negative");
    return a;
}

static void tss__get_head(tss__n_in *in) {
    if (in->size < 80 || tss__get(in) != TSS__MODEL_MAGIC) {
        in->at = 0;
        tss__in_fail(in, TSS_ERROR_FORMAT, "not a tss_neural file");
        return;
    }
    char text[96];
    uint64_t version = tss__get(in), bytes = tss__get(in), sum = tss__get(in);
    if (version != TSS__MODEL_VERSION)
        snprintf(text, sizeof text, "version %llu, this library reads version %u",
                 (unsigned long long)version, TSS__MODEL_VERSION);
    else if (bytes != in->size)
        snprintf(text, sizeof text, "the file should have %llu bytes: cut short or damaged",
                 (unsigned long long)bytes);
    else if (sum != tss__model_sum(in->p, in->size))
        snprintf(text, sizeof text, "the checksum is wrong: the file is damaged");
    else
        return;
    tss__in_fail(in, TSS_ERROR_FORMAT, text);
}

static void tss__get_model(tss__n_in *in, const tss_host *h, tss_model *m) {
    int parts = tss__get_int(in, 0, 3, "the list of parts");
    m->step = tss__get(in);
    for (int k = 0; k < 4; k++) m->rng.s[k] = tss__get(in);
    m->decoder = tss__get_net(in, h, "the decoder");
    if (in->result == TSS_OK && (parts & 1)) m->encoder = tss__get_net(in, h, "the encoder");
    if (in->result != TSS_OK) return;
    size_t count = m->decoder->theta[m->decoder->layers];
    if (m->encoder) count += m->encoder->theta[m->encoder->layers];
    if (parts & 2) m->adam = tss__get_adam(in, h, count);
    if (in->result == TSS_OK && in->at != in->size)
        tss__in_fail(in, TSS_ERROR_FORMAT, "there are bytes behind the end");
    if (in->result == TSS_OK && m->encoder &&
        (m->encoder->outputs != m->decoder->inputs || m->encoder->inputs != m->decoder->outputs))
        tss__in_fail(in, TSS_ERROR_FORMAT, "encoder and decoder do not fit each other");
}

tss_result tss_model_load(const tss_host *host, const void *data, size_t size, tss_model *out,
                          char *why, size_t why_size) {
    tss_host h = host ? *host : tss_host_default();
    tss__n_in in = {(const unsigned char *)data, 0, size, TSS_OK, why, why_size};
    memset(out, 0, sizeof *out);
    if (why && why_size) why[0] = 0;
    tss__get_head(&in);
    if (in.result == TSS_OK) tss__get_model(&in, &h, out);
    if (in.result != TSS_OK) tss_model_free(out);
    return in.result;
}

static tss_result tss__model_store(const char *path, const char *part, const void *data,
                                   size_t size) {
    FILE *f = fopen(part, "wb");
    if (!f) return TSS_ERROR_FILE;
    size_t done = fwrite(data, 1, size, f);
    int bad = fclose(f) != 0 || done != size;
    if (!bad && rename(part, path) == 0) return TSS_OK;
    remove(part);
    return TSS_ERROR_FILE;
}

tss_result tss_model_write(const tss_host *host, const tss_model *m, const char *path) {
    tss_host h = host ? *host : tss_host_default();
    size_t size = tss_model_save(m, NULL, 0), name = strlen(path) + 6;
    if (!size) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = TSS_ERROR_NO_MEMORY;
    void *data = tss_alloc(&h, size);
    char *part = (char *)tss_alloc(&h, name);
    if (data && part) {
        snprintf(part, name, "%s.part", path);
        tss_model_save(m, data, size);
        r = tss__model_store(path, part, data, size);
    }
    tss_free(&h, data, size), tss_free(&h, part, name);
    return r;
}

// The file's bytes in memory of the host, room: what to free. Grows as it reads: the size that a
// file system reports is not believed either.
static tss_result tss__model_fetch(const tss_host *h, const char *path, unsigned char **data,
                                   size_t *size, size_t *room) {
    FILE *f = fopen(path, "rb");
    tss_result r = f ? TSS_OK : TSS_ERROR_FILE;
    *data = NULL, *size = *room = 0;
    while (r == TSS_OK) {
        size_t more = *room ? 2 * *room : 65536, got;
        unsigned char *p = (unsigned char *)tss_alloc(h, more);
        if (!p) {
            r = TSS_ERROR_NO_MEMORY;
            break;
        }
        if (*size) memcpy(p, *data, *size);
        tss_free(h, *data, *room);
        *data = p, *room = more;
        got = fread(p + *size, 1, more - *size, f);
        *size += got;
        if (ferror(f)) r = TSS_ERROR_FILE;
        if (*size < more) break;
    }
    if (f) fclose(f);
    return r;
}

tss_result tss_model_read(const tss_host *host, const char *path, tss_model *out, char *why,
                          size_t why_size) {
    tss_host h = host ? *host : tss_host_default();
    unsigned char *data;
    size_t size, room;
    memset(out, 0, sizeof *out);
    tss_result r = tss__model_fetch(&h, path, &data, &size, &room);
    if (r != TSS_OK && why && why_size) snprintf(why, why_size, "%s: %s", path, tss_result_text(r));
    if (r == TSS_OK) r = tss_model_load(&h, data, size, out, why, why_size);
    tss_free(&h, data, room);
    return r;
}

// ---- other coordinates ----------------------------------------------------------------------

// A ← A⁻¹ (r × r) with room for r² more, by Gauss and Jordan with pivots of columns. 0: singular.
static int tss__n_invert(int r, double *A, double *R) {
    tss__n_identity(R, r);
    for (int k = 0; k < r; k++) {
        int p = k;
        for (int i = k + 1; i < r; i++)
            if (fabs(A[i * r + k]) > fabs(A[p * r + k])) p = i;
        if (!(fabs(A[p * r + k]) > 0) || !isfinite(A[p * r + k])) return 0;
        for (int j = 0; j < r; j++) {
            double a = A[p * r + j], b = R[p * r + j];
            A[p * r + j] = A[k * r + j], A[k * r + j] = a, R[p * r + j] = R[k * r + j],
                      R[k * r + j] = b;
        }
        double d = 1 / A[k * r + k];
        for (int j = 0; j < r; j++) A[k * r + j] *= d, R[k * r + j] *= d;
        for (int i = 0; i < r; i++) {
            double f = A[i * r + k];
            for (int j = 0; j < r && i != k; j++)
                A[i * r + j] -= f * A[k * r + j], R[i * r + j] -= f * R[k * r + j];
        }
    }
    memcpy(A, R, (size_t)(r * r) * sizeof(double));
    for (int i = 0; i < r * r; i++)
        if (!isfinite(A[i])) return 0;
    return 1;
}

tss_result tss_model_change_z(tss_model *m, const double *T) {
    tss_net *dec = m ? m->decoder : NULL, *enc = m ? m->encoder : NULL;
    if (!dec || !T || dec->has_in || dec->width[0] > 4096 ||
        (enc && (enc->map != TSS__MAP_NONE || enc->outputs != dec->width[0])))
        return TSS_ERROR_BAD_ARGUMENT;
    int r = dec->width[0], w = dec->width[1];
    size_t rr = (size_t)(r * r), bytes = (2 * rr + (size_t)r) * sizeof(double);
    double *inverse = (double *)tss_alloc(&dec->host, bytes), *col = inverse + 2 * rr;
    if (!inverse) return TSS_ERROR_NO_MEMORY;
    memcpy(inverse, T, rr * sizeof(double));
    int ok = tss__n_invert(r, inverse, inverse + rr);
    for (int j = 0; ok && j < w; j++) {  // rows of z: z W = y Tᵀ W
        for (int a = 0; a < r; a++) col[a] = dec->par[a * w + j];
        for (int a = 0; a < r; a++) {
            double s = 0;
            for (int b = 0; b < r; b++) s += T[b * r + a] * col[b];
            dec->par[a * w + j] = s;
        }
    }
    double *last = enc ? enc->par + enc->theta[enc->layers - 1] : NULL;
    for (int i = 0; ok && enc && i <= enc->width[enc->layers - 1];
         i++, last += r) {  // b is the last row
        memcpy(col, last, (size_t)r * sizeof(double));
        for (int a = 0; a < r; a++) {
            last[a] = 0;
            for (int b = 0; b < r; b++) last[a] += inverse[a * r + b] * col[b];
        }
    }
    tss_free(&dec->host, inverse, bytes);
    return ok ? TSS_OK : TSS_ERROR_BAD_ARGUMENT;
}

// ---------------------------------------------------------------------------------------------
// >>training (private)
// ---------------------------------------------------------------------------------------------

#define TSS__TRAINING_COOKIE 0x747261

struct tss_training {
    tss_host host;
    tss_training_def def;
    tss_work *work;
    size_t dec, enc;  // parameters
    double *p;        // one block
    size_t bytes;
    double *g, *x, *z, *z_bar, *probe;  // gradients; a batch of frames; of z
    double *held;                       // of a batch's frames
};

tss_training_def tss_training_def_default(void) {
    tss_training_def d;
    memset(&d, 0, sizeof d);
    d.batch = 32, d.lambda = d.sigma = 1, d.eps = 1e-8, d.lipschitz_batch = 16,
    d.through_encoder = 1;
    d.lipschitz = tss_lipschitz_def_default(), d.adam = tss_adam_def_default();
    d.cookie = TSS__TRAINING_COOKIE;
    return d;
}

static const char *tss__training_complaint(const tss_training_def *d) {
    const tss_model *m = d->model;
    if (!m || !m->decoder) return "training: no decoder";
    const tss_net *dec = m->decoder, *enc = m->encoder;
    int lip = d->lipschitz_weight != 0;
    if (dec->has_in) return "training: the decoder has an in_matrix";
    if (enc && (enc->outputs != dec->inputs || enc->inputs != dec->outputs))
        return "training: encoder and decoder do not fit each other";
    if (enc && (!d->frames || d->frame_count < 1)) return "training: an encoder, but no frames";
    if (!enc && (!d->elements || d->batch < 2))
        return "training: unsupervised needs elements and a batch of 2";
    if (d->batch < 1 || d->batch > (1 << 20) || d->lipschitz_batch > (1 << 20))
        return "training: batch out of range";
    if ((d->elements && !tss__n_fits(dec, d->elements)) ||
        (d->cubature && !tss__n_fits(dec, d->cubature)))
        return "training: elements and decoder have different coordinates";
    if (!(d->sigma > 0) || !(d->eps >= 0) || !isfinite(d->lambda))
        return "training: sigma, eps or lambda out of range";
    if (!(d->lipschitz_weight >= 0 && d->lipschitz_weight < 1e300))
        return "training: lipschitz_weight out of range";
    if (lip && !d->elements && !d->cubature) return "training: the Lipschitz loss needs elements";
    if (lip && !tss__lip_valid(dec, d->cubature ? d->cubature : d->elements, &d->lipschitz,
                               d->lipschitz_batch, d->frames ? d->frames : &d->sigma))
        return "training: the Lipschitz loss is out of range";
    tss_held held = {d->held_count, d->held, &d->sigma};
    if (d->held_count && (!enc || !d->held || !tss__held_fits(&held, dec)))
        return "training: held coordinates out of range, or without frames";
    if (!tss__adam_valid(&d->adam)) return "training: Adam out of range";
    if (m->adam && m->adam->count != dec->theta[dec->layers] + (enc ? enc->theta[enc->layers] : 0))
        return "training: the optimiser does not fit the networks";
    if (d->ramp && dec->map != TSS__MAP_SCATTER)
        return "training: ramp needs a decoder with out_scale";
    return NULL;
}

void tss_training_destroy(tss_training *t) {
    if (!t) return;
    tss_host h = t->host;
    tss_work_destroy(t->work);
    tss_free(&h, t->p, t->bytes);
    tss_free(&h, t, sizeof *t);
}

static int tss__training_arrays(tss_training *t) {
    const tss_net *dec = t->def.model->decoder, *enc = t->def.model->encoder;
    int most = t->def.batch > t->def.lipschitz_batch ? t->def.batch : t->def.lipschitz_batch;
    size_t rows = (size_t)most, r = (size_t)dec->inputs, n = enc ? (size_t)dec->outputs : 0;
    t->dec = dec->theta[dec->layers], t->enc = enc ? enc->theta[enc->layers] : 0;
    size_t held = (size_t)t->def.held_count;
    t->bytes = (t->dec + t->enc + rows * (n + 2 * r + held) + 2 * r * r) * sizeof(double);
    t->p = (double *)tss_alloc(&t->host, t->bytes);
    if (!t->p) return 0;
    t->g = t->p, t->x = t->g + t->dec + t->enc, t->z = t->x + rows * n, t->z_bar = t->z + rows * r;
    t->probe = t->z_bar + rows * r, t->held = t->probe + 2 * r * r;
    return tss_work_create(&t->host, &t->work) == TSS_OK &&
           (t->def.model->adam || tss_adam_create(&t->host, &t->def.adam, t->dec + t->enc,
                                                  &t->def.model->adam) == TSS_OK);
}

tss_result tss_training_create(const tss_host *host, const tss_training_def *def,
                               tss_training **out) {
    tss_host h = host ? *host : tss_host_default();
    *out = NULL;
    TSS_ASSERT(def->cookie == TSS__TRAINING_COOKIE && "tss_training_def: start from the default");
    const char *wrong = tss__training_complaint(def);
    if (wrong) return tss__n_refuse(&h, TSS_ERROR_BAD_ARGUMENT, wrong);
    tss_training *t = (tss_training *)tss_alloc(&h, sizeof *t);
    if (!t) return TSS_ERROR_NO_MEMORY;
    memset(t, 0, sizeof *t);
    t->host = h, t->def = *def;
    if (!tss__training_arrays(t)) {
        tss_training_destroy(t);
        return TSS_ERROR_NO_MEMORY;
    }
    const uint64_t *s = def->model->rng.s;
    if (!(s[0] | s[1] | s[2] | s[3])) def->model->rng = tss_rng_seed(0);  // zeros would stay zeros
    *out = t;
    return TSS_OK;
}

static void tss__training_frames(tss_training *t, int count) {
    size_t n = (size_t)t->def.model->decoder->outputs;
    for (int i = 0; i < count; i++) {
        size_t f = (size_t)(tss_rng_uniform(&t->def.model->rng) * t->def.frame_count);
        memcpy(t->x + (size_t)i * n, t->def.frames + f * n, n * sizeof(double));
    }
}

static void tss__training_normals(tss_training *t, double *to, int count) {
    for (int i = 0; i < count * t->def.model->decoder->inputs; i++)
        to[i] = tss_rng_normal(&t->def.model->rng);
}

// Normal samples to t->z_bar, S times them to t->z.
static void tss__training_samples(tss_training *t, int count) {
    int r = t->def.model->decoder->inputs;
    const double *S = t->def.spread;
    tss__training_normals(t, t->z_bar, count);
    for (int i = 0; i < count * r; i++) {
        const double *n = t->z_bar + i - i % r;
        t->z[i] = S ? 0 : t->z_bar[i];
        for (int b = 0; S && b < r; b++) t->z[i] += S[i % r * r + b] * n[b];
    }
}

static tss_result tss__training_vanilla(tss_training *t, double ramp, tss_training_info *info) {
    const tss_training_def *d = &t->def;
    const tss_model *m = d->model;
    if (m->encoder) {
        tss__training_frames(t, d->batch);
        return tss_loss_reconstruction(m->decoder, m->encoder, t->work, d->mass, d->batch, t->x, 1,
                                       &info->loss, t->g, t->g + t->dec);
    }
    tss__training_samples(t, d->batch);
    return tss__unsupervised(m->decoder, d->elements, t->work, d->mass, d->lambda, d->sigma * ramp,
                             d->eps, d->batch, t->z, t->z_bar, 1, &info->loss, info->parts, t->g);
}

// λ_LS L_LS on samples of the pull-back distribution (§4.2): encoded frames, or N(0, 1).
static tss_result tss__training_lipschitz(tss_training *t, tss_training_info *info) {
    const tss_training_def *d = &t->def;
    const tss_model *m = d->model;
    int B = d->lipschitz_batch, r = m->decoder->inputs;
    tss_held held = {d->held_count, d->held, t->held};
    tss_lipschitz_def ld = d->lipschitz;
    ld.held = d->held_count ? &held : NULL;
    double *probe = d->lipschitz.estimator == TSS_LIPSCHITZ_EXACT ? NULL : t->probe;
    double *z_bar = m->encoder && d->through_encoder ? t->z_bar : NULL;
    tss_result result = TSS_OK;
    if (m->encoder) {
        tss__training_frames(t, B);
        result = tss_net_forward(m->encoder, t->work, B, t->x, t->z);
        for (int i = 0, n = d->held_count; i < B * n; i++)
            t->held[i] =
                t->x[(size_t)(i / n) * (size_t)m->decoder->outputs + (size_t)d->held[i % n]];
    } else {
        tss__training_samples(t, B);
    }
    if (probe) tss__training_normals(t, probe, 2 * d->lipschitz.probes);
    if (z_bar) tss__n_zero(z_bar, (size_t)(B * r));
    if (result == TSS_OK)
        result =
            tss_loss_lipschitz(m->decoder, d->cubature ? d->cubature : d->elements, t->work, &ld, B,
                               t->z, probe, d->lipschitz_weight, &info->lipschitz, t->g, z_bar);
    if (result == TSS_OK && z_bar)
        result = tss_net_backward(m->encoder, t->work, B, t->x, z_bar, t->g + t->dec, NULL);
    return result;
}

tss_result tss_training_step(tss_training *t, tss_training_info *out) {
    const tss_training_def *d = &t->def;
    tss_model *m = d->model;
    tss_training_info info;
    tss_rng before = m->rng;
    double ramp = 1, scale = m->decoder->scale;
    memset(&info, 0, sizeof info);
    if (m->step < d->ramp) ramp = (double)(m->step + 1) / (double)d->ramp;
    if (d->ramp) tss_net_set_scale(m->decoder, ramp);
    tss__n_zero(t->g, t->dec + t->enc);
    tss_result r = tss__training_vanilla(t, ramp, &info);
    if (r == TSS_OK && d->lipschitz_weight > 0 && m->step >= d->lipschitz_from)
        r = tss__training_lipschitz(t, &info);
    if (r != TSS_OK) {  // as if it had not been called
        m->rng = before;
        tss_net_set_scale(m->decoder, scale);
        return r;
    }
    // Squares, for the second moments: an infinite one would stay.
    for (size_t i = 0; i < t->dec + t->enc; i++) info.skipped |= !isfinite(t->g[i] * t->g[i]);
    info.rate = tss_adam_rate(m->adam);
    if (!info.skipped) {
        tss_adam_update(m->adam, 0, t->dec, m->decoder->par, t->g);
        if (m->encoder) tss_adam_update(m->adam, t->dec, t->enc, m->encoder->par, t->g + t->dec);
        tss_adam_advance(m->adam);
    }
    m->step++;
    if (out) *out = info;
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>reduced_solver (private)
// With φ(z) the values that the decoder's last linear map takes (its last hidden layer, or the
// MLP's output where the fixed matrix has fewer columns), f(z) = c + B φ. So
//     ‖f − q̄‖²_M = (φ − φ̄)ᵀ G (φ − φ̄) − 2 w·(φ − φ̄) + const,   G = BᵀMB, φ̄ = 2φ_t − φ_{t−1},
// and force·f is linear. Handles leave G (rank-one terms, when their nodes change) and make w: the
// rows of nodes whose x_t or x_{t−1} were not on c + Bφ. Only the rows of B that elements and
// contact touch are multiplied in an evaluation: `rows` of them, transposed and contiguous.
// ---------------------------------------------------------------------------------------------

#define TSS__REDUCED_COOKIE 0x726564
#define TSS__REDUCED_DENSE 1024  // r up to which there is a Hessian

typedef struct tss__n_held {  // nodes that are not where f puts them
    int count, *node, *at;    // at: of each node of the mesh, 1 + its place in node; 0: not held
    double *x;                // count × dim
} tss__n_held;

struct tss_reduced {
    tss_host host;
    tss_reduced_def def;
    int r, dim, nodes, top;  // top: linear layers before φ
    int k_most;              // directions of an evaluation: r or 0
    int pairs, newest;       // of the L-BFGS history
    size_t n, m, rows, panel_size;
    double *p;  // one block
    size_t bytes;
    int *ints;  // another
    size_t int_bytes;
    double *mass, *force, *c, *B, *G, *G_free;  // n, n, n, n × m, m × m twice
    double *c_rows, *B_rows;                    // rows; m × rows
    int *row_node;                              // rows / dim: nodes of the rows, ascending
    int *cell, *hinge, *near, contacts;         // of the elements, and contact nodes, by row
    double *near_weight;
    double *z, *z_last, *phi, *phi_last, *x;  // state; x is decoded on demand
    int *decoded;
    tss__n_held held[3];  // from now on; at x_t; at x_{t−1}
    unsigned *seen, stamp;
    double *force_phi, force_c;  // Bᵀ force, force·c
    // What an evaluation minimises: half·(the quadratic) + the rest, unless fit.
    int fit;
    double half, offset, constant;  // constant: of the quadratic; offset: of the forces
    const double *quad;
    double *phi_bar, *w, *u, *gap;
    double *tape, *slope, *mid, *bar, *next, *X, *Xbar, *panel, *scratch;
    double *S, *Y, *curve, *part, *g, *g_new, *d, *z_new;  // S, Y: memory × r
    double *H, *V, *lambda;  // r × r twice, r. BFGS: H is the inverse Hessian, if `known`
    // BFGS: φ of the iterate; which contact nodes touch at the last evaluation, at the iterate, and
    // where H began; the size of f(start) in ‖·‖_M; every coordinate that f moves is a handle's.
    double *phi_at, size;
    uint64_t touching, touching_at, touching_then;
    int known, all_held;
    double energy, scale;
    int evaluations, hessians;
    uint64_t exits[TSS_EXITS];
};

tss_reduced_def tss_reduced_def_default(void) {
    tss_reduced_def d;
    memset(&d, 0, sizeof d);
    d.h = 0.05, d.solver = TSS_BFGS, d.tol = 1e-4, d.eps = 1e-5, d.ftol = 2.2e-9, d.memory = 10;
    d.max_line = 128, d.max_iterations = 1024, d.shift = 1e-6;
    d.cookie = TSS__REDUCED_COOKIE;
    return d;
}

static const char *tss__reduced_complaint(const tss_reduced_def *d) {
    if (!(d->h >= 0 && d->h < 1e300)) return "reduced solver: h must be >= 0";
    if (d->h > 0 && !d->mass) return "reduced solver: dynamics need masses";
    double all = 0;
    for (int i = 0; d->mass && i < d->decoder->outputs; i++) {
        if (!(d->mass[i] >= 0 && d->mass[i] < 1e300))
            return "reduced solver: a mass is negative or not finite";
        all += d->mass[i];
    }
    if (!(d->tol >= 0) || !(d->eps >= 0) || !(d->ftol >= 0))
        return "reduced solver: a tolerance is negative";
    if (d->memory < 1 || d->memory > 64 || d->max_line < 1 || d->max_iterations < 0)
        return "reduced solver: memory, max_line or max_iterations out of range";
    if (d->decoder->inputs > (1 << 24)) return "reduced solver: more than 2^24 inputs";
    if (d->solver != TSS_LBFGS && d->solver != TSS_PROJECTED_NEWTON && d->solver != TSS_BFGS)
        return "reduced solver: unknown solver";
    if (d->solver != TSS_LBFGS && d->decoder->inputs > TSS__REDUCED_DENSE)
        return "reduced solver: BFGS and projected Newton take at most 1024 inputs, L-BFGS more";
    if (!(d->shift > 0 && d->shift < 1e300)) return "reduced solver: shift must be > 0";
    if (d->solver == TSS_BFGS && d->mass && !(all > 0))
        return "reduced solver: BFGS measures moves by masses, and all masses are 0";
    return NULL;
}

static const char *tss__contact_complaint(const tss_reduced_def *d, int nodes) {
    if (!d->sdf) return NULL;
    int count = d->contact_node ? d->contact_count : nodes;
    if (!(d->contact_stiffness >= 0 && d->contact_stiffness < 1e300) ||
        !isfinite(d->contact_margin))
        return "reduced solver: contact_stiffness or contact_margin out of range";
    if (count < 0 || count > nodes) return "reduced solver: contact_count out of range";
    for (int i = 0; d->contact_node && i < count; i++)
        if (d->contact_node[i] < 0 || d->contact_node[i] >= nodes)
            return "reduced solver: a contact node is out of range";
    for (int i = 0; d->contact_weight && i < count; i++)
        if (!(d->contact_weight[i] >= 0 && d->contact_weight[i] < 1e300))
            return "reduced solver: a contact weight is negative or not finite";
    return NULL;
}

void tss_reduced_destroy(tss_reduced *s) {
    if (!s) return;
    tss_host h = s->host;
    tss_free(&h, s->p, s->bytes);
    tss_free(&h, s->ints, s->int_bytes);
    tss_free(&h, s, sizeof *s);
}

// ---- memory ---------------------------------------------------------------------------------

// The nodes whose rows an evaluation needs: held[0].at serves as their mark. Sets rows.
static void tss__reduced_mark(tss_reduced *s) {
    const tss_elements *e = s->def.elements;
    int *mark = s->held[0].at;
    for (int i = 0; e && i < e->used; i++) mark[e->dof[i * s->dim] / s->dim] = 1;
    for (int i = 0; i < s->contacts; i++) mark[s->near[i]] = 1;
    s->rows = 0;
    for (int i = 0; i < s->nodes; i++) {
        if (!mark[i]) continue;
        s->row_node[s->rows] = i, mark[i] = (int)++s->rows;
    }
}

// Numbers cells, hinges and contact nodes by rows, and takes the marks away.
static void tss__reduced_number(tss_reduced *s) {
    const tss_elements *e = s->def.elements;
    int *mark = s->held[0].at;
    for (int i = 0; e && i < e->cells * e->per; i++) s->cell[i] = mark[e->cell[i]] - 1;
    for (int i = 0; e && i < 4 * e->hinges; i++) s->hinge[i] = mark[e->hinge[i]] - 1;
    for (int i = 0; i < s->contacts; i++) s->near[i] = mark[s->near[i]] - 1;
    memset(mark, 0, (size_t)s->nodes * sizeof(int));
    s->rows *= (size_t)s->dim;
}

static int tss__reduced_ints(tss_reduced *s) {
    const tss_elements *e = s->def.elements;
    size_t nodes = (size_t)s->nodes, cells = e ? (size_t)e->cells * (size_t)e->per : 0;
    size_t hinges = e ? 4 * (size_t)e->hinges : 0, near = (size_t)s->contacts;
    size_t all = 8 * nodes + cells + hinges + near + 1;
    s->int_bytes = all * sizeof(int);
    s->ints = (int *)tss_alloc(&s->host, s->int_bytes);
    if (!s->ints) return 0;
    memset(s->ints, 0, s->int_bytes);
    int *p = s->ints;
    for (int k = 0; k < 3; k++) s->held[k].node = p, s->held[k].at = p + nodes, p += 2 * nodes;
    s->seen = (unsigned *)(void *)p, s->row_node = p + nodes, p += 2 * nodes;
    s->cell = p, s->hinge = p + cells, s->near = s->hinge + hinges, s->decoded = s->near + near;
    for (int i = 0; i < s->contacts; i++)
        s->near[i] = s->def.contact_node ? s->def.contact_node[i] : i;
    tss__reduced_mark(s);
    tss__reduced_number(s);
    return 1;
}

static void tss__reduced_carve(tss_reduced *s, tss__n_slab *b) {
    const tss_net *net = s->def.decoder;
    size_t r = (size_t)s->r, n = s->n, m = s->m, M = (size_t)s->def.memory;
    size_t cols = 1 + (size_t)s->k_most, H = s->k_most ? r : 0, tape = net->off[s->top + 1];
    size_t x_cols = 1 + (s->def.solver != TSS_LBFGS ? r : 0);
    double **of_r[] = {&s->z, &s->z_last, &s->g, &s->g_new, &s->d, &s->z_new, &s->lambda};
    double **of_n[] = {&s->mass,      &s->force,     &s->c,        &s->x,
                       &s->held[0].x, &s->held[1].x, &s->held[2].x};
    double **of_m[] = {&s->phi, &s->phi_last, &s->phi_bar,   &s->w,
                       &s->u,   &s->gap,      &s->force_phi, &s->phi_at};
    for (int k = 0; k < 7; k++) *of_r[k] = tss__n_take(b, 1, r);
    for (int k = 0; k < 7; k++) *of_n[k] = tss__n_take(b, 1, n);
    for (int k = 0; k < 8; k++) *of_m[k] = tss__n_take(b, 1, m);
    s->S = tss__n_take(b, (double)M, r), s->Y = tss__n_take(b, (double)M, r);
    s->curve = tss__n_take(b, 1, M), s->part = tss__n_take(b, 1, M);
    s->H = tss__n_take(b, (double)H, H), s->V = tss__n_take(b, (double)H, H);
    s->B = tss__n_take(b, (double)n, m), s->c_rows = tss__n_take(b, 1, s->rows);
    s->G = tss__n_take(b, (double)m, m), s->G_free = tss__n_take(b, (double)m, m);
    s->B_rows = tss__n_take(b, (double)m, s->rows);
    s->near_weight = tss__n_take(b, 1, (size_t)s->contacts);
    s->tape = tss__n_take(b, (double)cols, tape), s->mid = tss__n_take(b, (double)cols, tape);
    s->slope = tss__n_take(b, 2, tape);
    s->bar = tss__n_take(b, (double)cols, (size_t)net->widest);
    s->next = tss__n_take(b, (double)cols, (size_t)net->widest);
    s->X = tss__n_take(b, (double)x_cols, s->rows);
    s->Xbar = tss__n_take(b, (double)x_cols, s->rows);
    s->panel_size = s->rows > (size_t)net->widest ? s->rows : (size_t)net->widest;
    if (cols > s->panel_size) s->panel_size = cols;
    s->panel = tss__n_take(b, 8, s->panel_size);
    s->scratch = tss__n_take(b, TSS__N_CELL, 3 * x_cols + 2);
}

static int tss__reduced_arrays(tss_reduced *s) {
    tss__n_slab b = {NULL, 0, 0};
    if (!tss__reduced_ints(s)) return 0;
    tss__reduced_carve(s, &b);
    if (b.want >= 1e15) return 0;
    s->bytes = b.used * sizeof(double);
    s->p = (double *)tss_alloc(&s->host, s->bytes);
    if (!s->p) return 0;
    tss__n_zero(s->p, b.used);
    b.base = s->p, b.used = 0;
    tss__reduced_carve(s, &b);
    return 1;
}

// ---- the affine end of the decoder ----------------------------------------------------------

// Sums with a fixed order that the compiler can keep in registers of eight.
static double tss__n_dot8(size_t n, const double *a, const double *b) {
    double acc[8] = {0}, s = 0;
    size_t i = 0;
    for (; i + 8 <= n; i += 8)
        for (size_t c = 0; c < 8; c++) acc[c] += a[i + c] * b[i + c];
    for (; i < n; i++) s += a[i] * b[i];
    return s + (((acc[0] + acc[4]) + (acc[2] + acc[6])) + ((acc[1] + acc[5]) + (acc[3] + acc[7])));
}

static void tss__n_axpy(size_t n, double f, const double *x, double *y) {
    for (size_t i = 0; i < n; i++) y[i] += f * x[i];
}

// y += Σ f_a x_a over `count` rows of x, four at a time: y is read and written less often.
static void tss__n_combine(size_t n, size_t count, const double *f, const double *x, double *y) {
    size_t a = 0;
    for (; a + 4 <= count; a += 4) {
        const double *p = x + a * n, *q = p + n, *r = q + n, *s = r + n;
        double e = f[a], g = f[a + 1], h = f[a + 2], k = f[a + 3];
        for (size_t i = 0; i < n; i++) y[i] += (e * p[i] + g * q[i]) + (h * r[i] + k * s[i]);
    }
    for (; a < count; a++) tss__n_axpy(n, f[a], x + a * n, y);
}

// c and B, row by row.
static void tss__reduced_affine(tss_reduced *s) {
    const tss_net *net = s->def.decoder;
    size_t m = s->m, last = (size_t)net->width[net->layers];
    const double *W = net->par + net->theta[net->layers - 1], *b = W + m * last;
    for (size_t i = 0; i < s->n; i++) {
        double *row = s->B + i * m, f = net->map == TSS__MAP_SCATTER ? net->scale : 1;
        int from = net->map == TSS__MAP_SCATTER ? net->from[i] : (int)i;
        s->c[i] = net->map ? net->out_base[i] : 0;
        if (net->map == TSS__MAP_MATRIX && s->top == net->layers) {
            memcpy(row, net->out_matrix + i * m, m * sizeof(double));
        } else if (net->map == TSS__MAP_MATRIX) {
            const double *out = net->out_matrix + i * last;
            for (size_t k = 0; k < m; k++) row[k] = tss__n_dot8(last, W + k * last, out);
            s->c[i] += tss__n_dot8(last, b, out);
        } else if (from >= 0) {
            for (size_t k = 0; k < m; k++) row[k] = f * W[k * last + (size_t)from];
            s->c[i] += f * b[from];
        }
    }
    for (size_t q = 0; q < s->rows; q++) {
        size_t d = (size_t)s->dim, i = (size_t)s->row_node[q / d] * d + q % d;
        s->c_rows[q] = s->c[i];
        for (size_t k = 0; k < m; k++) s->B_rows[k * s->rows + q] = s->B[i * m + k];
    }
}

// G += f b bᵀ for the row b of coordinate i.
static void tss__reduced_rank_one(const tss_reduced *s, double f, size_t i, double *G) {
    const double *b = s->B + i * s->m;
    for (size_t a = 0; f != 0 && a < s->m; a++) tss__n_axpy(s->m, f * b[a], b, G + a * s->m);
}

static double tss__reduced_trace(const tss_reduced *s, const double *G) {
    double sum = 0;
    for (size_t a = 0; a < s->m; a++) sum += G[a * s->m + a];
    return sum;
}

static double tss__reduced_at(const tss_reduced *s, size_t i, const double *phi) {
    return s->c[i] + tss__n_dot8(s->m, s->B + i * s->m, phi);
}

static void tss__reduced_fill(tss_reduced *s) {
    for (size_t i = 0; i < s->n; i++) s->mass[i] = s->def.mass ? s->def.mass[i] : 1;
    for (int i = 0; i < s->contacts; i++)
        s->near_weight[i] = s->def.contact_weight ? s->def.contact_weight[i] : 1;
    tss__reduced_affine(s);
    for (size_t i = 0; i < s->n; i++) tss__reduced_rank_one(s, s->mass[i], i, s->G);
    memcpy(s->G_free, s->G, s->m * s->m * sizeof(double));
}

// Σ m |x_i − mean|²: the squared size of x in ‖·‖_M.
static double tss__reduced_size(const tss_reduced *s, const double *x) {
    double all = 0;
    for (size_t a = 0, d = (size_t)s->dim; a < d; a++) {
        double mean = 0;
        for (size_t i = a; i < s->n; i += d) mean += x[i] / s->nodes;
        for (size_t i = a; i < s->n; i += d) all += s->mass[i] * (x[i] - mean) * (x[i] - mean);
    }
    return all;
}

// elements NULL: for projection alone.
static tss_result tss__reduced_make(const tss_host *host, const tss_reduced_def *def, int dim,
                                    tss_reduced **out) {
    const tss_net *net = def->decoder;
    tss_reduced *s = (tss_reduced *)tss_alloc(host, sizeof *s);
    if (!s) return TSS_ERROR_NO_MEMORY;
    memset(s, 0, sizeof *s);
    s->host = *host, s->def = *def, s->r = net->inputs, s->n = (size_t)net->outputs, s->dim = dim;
    s->nodes = net->outputs / dim;
    s->top = net->layers - 1;
    if (net->map == TSS__MAP_MATRIX && net->width[net->layers] < net->width[s->top])
        s->top = net->layers;
    s->m = (size_t)net->width[s->top];
    s->k_most = s->r <= TSS__REDUCED_DENSE ? s->r : 0;
    if (def->sdf) s->contacts = def->contact_node ? def->contact_count : s->nodes;
    if (!tss__reduced_arrays(s)) {
        tss_reduced_destroy(s);
        return TSS_ERROR_NO_MEMORY;
    }
    tss__reduced_fill(s);
    if (tss_reduced_set(s, def->start ? def->start : s->z) != TSS_OK) {
        tss_reduced_destroy(s);
        return tss__n_refuse(host, TSS_ERROR_BAD_ARGUMENT,
                             "reduced solver: start or f(start) is not finite");
    }
    s->size = sqrt(tss__reduced_size(s, tss_reduced_x(s)));
    if (!(s->size > 0 && isfinite(s->size))) s->size = 1;
    *out = s;
    return TSS_OK;
}

tss_result tss_reduced_create(const tss_host *host, const tss_reduced_def *def, tss_reduced **out) {
    tss_host h = host ? *host : tss_host_default();
    *out = NULL;
    TSS_ASSERT(def->cookie == TSS__REDUCED_COOKIE && "tss_reduced_def: start from the default");
    if (!def->decoder || !def->elements || !tss__n_fits(def->decoder, def->elements))
        return tss__n_refuse(&h, TSS_ERROR_BAD_ARGUMENT,
                             "reduced solver: decoder and elements do not fit each other");
    const char *wrong = tss__reduced_complaint(def);
    if (!wrong) wrong = tss__contact_complaint(def, def->elements->nodes);
    if (wrong) return tss__n_refuse(&h, TSS_ERROR_BAD_ARGUMENT, wrong);
    return tss__reduced_make(&h, def, def->elements->dim, out);
}

// ---- one evaluation -------------------------------------------------------------------------

static double *tss__reduced_layer(const tss_reduced *s, double *tape, int l) {
    return tape + (1 + (size_t)s->k_most) * s->def.decoder->off[l];
}

// σ of layer l on all rows; its first two derivatives stay for the way back.
static void tss__reduced_activate(tss_reduced *s, int l, int k) {
    const tss_net *net = s->def.decoder;
    size_t w = (size_t)net->width[l];
    double *S = tss__reduced_layer(s, s->mid, l), *H = tss__reduced_layer(s, s->tape, l);
    double *d1 = s->slope + 2 * net->off[l], *d2 = d1 + w;
    for (size_t o = 0; o < w; o++) {
        double d[4];
        tss__n_activate(net->activation, S[o], d);
        H[o] = d[0], d1[o] = d[1], d2[o] = d[2];
    }
    for (size_t a = 1; a <= (size_t)k; a++)
        for (size_t o = 0; o < w; o++) H[a * w + o] = d1[o] * S[a * w + o];
}

// φ at z and, for k > 0, its derivatives along each z_a; row a of the result is along z_{a−1}.
static double *tss__reduced_forward(tss_reduced *s, const double *z, int k) {
    const tss_net *net = s->def.decoder;
    size_t r = (size_t)s->r, K = (size_t)k;
    double *in = tss__reduced_layer(s, s->tape, 0);
    memcpy(in, z, r * sizeof(double));
    if (k) tss__n_identity(in + r, k);
    for (int l = 0; l < s->top; l++) {
        size_t w = (size_t)net->width[l], out = (size_t)net->width[l + 1];
        const double *W = net->par + net->theta[l], *x = tss__reduced_layer(s, s->tape, l);
        int curved = l + 1 < net->layers;
        double *S = tss__reduced_layer(s, curved ? s->mid : s->tape, l + 1);
        memcpy(S, W + w * out, out * sizeof(double));
        tss__n_combine(out, w, x, W, S);
        tss__n_zero(S + out, K * out);
        tss__n_product(K, out, w, tss__n_rows(x + w, w), tss__n_rows(W, out), S + out, out,
                       s->panel);
        if (curved) tss__reduced_activate(s, l + 1, k);
    }
    return tss__reduced_layer(s, s->tape, s->top);
}

// From the adjoint of φ (and its derivatives; s->bar) to the gradient and the rows of the Hessian.
static void tss__reduced_backward(tss_reduced *s, int k, double *g, double *H) {
    const tss_net *net = s->def.decoder;
    size_t K = (size_t)k, r = (size_t)s->r;
    double *bar = s->bar, *next = s->next;
    for (int l = s->top; l > 0; l--) {
        size_t w = (size_t)net->width[l], in = (size_t)net->width[l - 1];
        const double *W = net->par + net->theta[l - 1], *S = tss__reduced_layer(s, s->mid, l);
        const double *d1 = s->slope + 2 * net->off[l], *d2 = d1 + w;
        if (l < net->layers) {
            for (size_t a = 1; a <= K; a++)
                for (size_t o = 0; o < w; o++)
                    bar[a * w + o] = d1[o] * bar[a * w + o] + d2[o] * S[a * w + o] * bar[o];
            for (size_t o = 0; o < w; o++) bar[o] *= d1[o];
        }
        for (size_t i = 0; i < in; i++) next[i] = tss__n_dot8(w, W + i * w, bar);
        tss__n_zero(next + in, K * in);
        tss__n_product(K, in, w, tss__n_rows(bar + w, w), tss__n_turned(tss__n_rows(W, w)),
                       next + in, in, s->panel);
        double *swap = bar;
        bar = next, next = swap;
    }
    memcpy(g, bar, r * sizeof(double));
    if (k) memcpy(H, bar + r, r * r * sizeof(double));
}

// C and its derivatives; the Hessian is k a n nᵀ.
static double tss__reduced_contact(tss_reduced *s, int k) {
    int d = s->dim;
    double C = 0;
    s->touching = 0;
    for (int i = 0; i < s->contacts; i++) {
        size_t at = (size_t)s->near[i] * (size_t)d;
        double n[3] = {0}, f = s->def.contact_stiffness * s->near_weight[i];
        double gap = s->def.sdf(s->def.sdf_user, s->X + at, n) - s->def.contact_margin;
        if (isnan(gap)) return gap;
        if (gap >= 0) continue;
        s->touching = (s->touching ^ (uint64_t)(i + 1)) * 1099511628211u;  // FNV-1a
        C += 0.5 * f * gap * gap;
        for (int a = 0; a < d; a++) s->Xbar[at + (size_t)a] += f * gap * n[a];
        for (int q = 1; q <= k; q++) {
            size_t row = (size_t)q * s->rows + at;
            double along = f * tss__dot_n(d, n, s->X + row);
            for (int a = 0; a < d; a++) s->Xbar[row + (size_t)a] += along * n[a];
        }
    }
    return C;
}

// Rows of handles: where they are, or 0 (derivatives, adjoints).
static void tss__reduced_hold(const tss_reduced *s, double *rows, int first, int k, int zero) {
    size_t d = (size_t)s->dim, nodes = s->rows / d;
    for (size_t q = 0; s->held[0].count && q < nodes; q++) {
        int at = s->held[0].at[s->row_node[q]];
        if (!at) continue;
        for (int a = first; a <= k; a++)
            for (size_t c = 0; c < d; c++)
                rows[(size_t)a * s->rows + q * d + c] =
                    zero || a ? 0 : s->held[0].x[(size_t)(at - 1) * d + c];
    }
}

// P + C at φ; adds their adjoints to s->bar.
static double tss__reduced_bodies(tss_reduced *s, const double *phi, int k) {
    size_t T = s->rows, m = s->m, K = (size_t)k;
    const tss_elements *e = s->def.elements;
    double E = 0;
    memcpy(s->X, s->c_rows, T * sizeof(double));
    tss__n_combine(T, m, phi, s->B_rows, s->X);
    tss__n_zero(s->X + T, K * T), tss__n_zero(s->Xbar, (1 + K) * T);
    tss__n_product(K, T, m, tss__n_rows(phi + m, m), tss__n_rows(s->B_rows, T), s->X + T, T,
                   s->panel);
    tss__reduced_hold(s, s->X, 0, k, 0);
    if (k == 0) {
        E = tss__elements_gradient(e, s->cell, s->hinge, s->X, s->Xbar);
    } else {
        tss__n_jet t;
        memset(&t, 0, sizeof t);
        t.e = e, t.cell = s->cell, t.hinge = s->hinge, t.mode = TSS__CELL_TANGENT, t.k = k;
        t.x = s->X, t.ld = T, t.bar = s->Xbar, t.scratch = s->scratch;
        tss__jet_run(&t);
        E = t.P;
    }
    if (s->contacts) E += tss__reduced_contact(s, k);
    tss__reduced_hold(s, s->Xbar, 0, k, 1);
    for (size_t a = 0; a < m; a++) s->bar[a] += tss__n_dot8(T, s->B_rows + a * T, s->Xbar);
    tss__n_product(K, m, T, tss__n_rows(s->Xbar + T, T), tss__n_turned(tss__n_rows(s->B_rows, T)),
                   s->bar + m, m, s->panel);
    return E;
}

// E where tss__reduced_forward has just been, whose result is phi; its gradient to g and, if it was
// asked for derivatives, its Hessian to H (else NULL).
static double tss__reduced_energy_there(tss_reduced *s, const double *phi, double *g, double *H) {
    int k = H ? s->r : 0;
    size_t m = s->m;
    double E = s->offset;
    if (H)
        s->hessians++;
    else
        s->evaluations++;
    // The quadratic: half ((φ − φ̄)ᵀ Q (φ − φ̄) − 2 w·(φ − φ̄) + constant) − u·φ.
    for (size_t a = 0; a < m; a++) s->gap[a] = phi[a] - s->phi_bar[a];
    tss__n_zero(s->bar, (1 + (size_t)k) * m);
    for (size_t c = 0; s->half > 0 && c <= (size_t)k; c++) {
        const double *v = c ? phi + c * m : s->gap;
        for (size_t a = 0; a < m; a++)
            s->bar[c * m + a] = 2 * s->half * tss__n_dot8(m, s->quad + a * m, v);
    }
    if (s->half > 0) {
        E += 0.5 * tss__n_dot8(m, s->gap, s->bar) -
             s->half * (2 * tss__n_dot8(m, s->w, s->gap) - s->constant);
        for (size_t a = 0; a < m; a++) s->bar[a] -= 2 * s->half * s->w[a];
    }
    E -= tss__n_dot8(m, s->u, phi);
    for (size_t a = 0; a < m; a++) s->bar[a] -= s->u[a];
    if (!s->fit) E += tss__reduced_bodies(s, phi, k);
    tss__reduced_backward(s, k, g, H);
    return E;
}

// E at z, its gradient to g and its Hessian to H (NULL: not wanted).
static double tss__reduced_energy(tss_reduced *s, const double *z, double *g, double *H) {
    return tss__reduced_energy_there(s, tss__reduced_forward(s, z, H ? s->r : 0), g, H);
}

// ---- state ----------------------------------------------------------------------------------

static void tss__held_copy(const tss_reduced *s, const tss__n_held *from, tss__n_held *to) {
    for (int k = 0; k < to->count; k++) to->at[to->node[k]] = 0;
    to->count = from->count;
    for (int k = 0; k < from->count; k++) to->at[to->node[k] = from->node[k]] = k + 1;
    memcpy(to->x, from->x, (size_t)(from->count * s->dim) * sizeof(double));
}

// The state moves on: what is at x_t becomes x_{t−1}, φ(z) and the handles become x_t.
static void tss__reduced_advance(tss_reduced *s) {
    tss__n_held swap = s->held[2];
    double *phi = s->phi_last;
    s->held[2] = s->held[1], s->held[1] = swap;
    s->phi_last = s->phi, s->phi = phi;
    tss__held_copy(s, &s->held[0], &s->held[1]);
    memcpy(s->phi, tss__reduced_forward(s, s->z, 0), s->m * sizeof(double));
    *s->decoded = 0;
}

tss_result tss_reduced_set(tss_reduced *s, const double *z) {
    for (int i = 0; i < s->r; i++)
        if (!isfinite(z[i])) return TSS_ERROR_BAD_STATE;
    const double *phi = tss__reduced_forward(s, z, 0);
    for (size_t a = 0; a < s->m; a++)
        if (!isfinite(phi[a])) return TSS_ERROR_BAD_STATE;
    if (z != s->z) memcpy(s->z, z, (size_t)s->r * sizeof(double));
    memcpy(s->z_last, s->z, (size_t)s->r * sizeof(double));
    tss__reduced_advance(s);
    tss__reduced_advance(s);
    s->known = 0;
    return TSS_OK;
}

void tss_reduced_set_force(tss_reduced *s, const double *force) {
    if (force)
        memcpy(s->force, force, s->n * sizeof(double));
    else
        tss__n_zero(s->force, s->n);
    tss__n_zero(s->force_phi, s->m);
    s->force_c = 0;
    for (size_t i = 0; i < s->n; i++) {
        if (s->force[i] == 0) continue;
        s->force_c += s->force[i] * s->c[i];
        tss__n_axpy(s->m, s->force[i], s->B + i * s->m, s->force_phi);
    }
}

static const char *tss__handles_complaint(tss_reduced *s, int count, const int *node,
                                          const double *x) {
    if (count < 0 || count > s->nodes || (count > 0 && (!node || !x)))
        return "reduced solver: handles without nodes or positions, or too many";
    s->stamp++;
    for (int k = 0; k < count; k++) {
        if (node[k] < 0 || node[k] >= s->nodes) return "reduced solver: a handle is out of range";
        if (s->seen[node[k]] == s->stamp) return "reduced solver: a handle is named twice";
        s->seen[node[k]] = s->stamp;
    }
    for (int i = 0; i < count * s->dim; i++)
        if (!isfinite(x[i])) return "reduced solver: a handle's position is not finite";
    return NULL;
}

tss_result tss_reduced_set_handles(tss_reduced *s, int count, const int *node, const double *x) {
    const char *wrong = tss__handles_complaint(s, count, node, x);
    if (wrong) return tss__n_refuse(&s->host, TSS_ERROR_BAD_ARGUMENT, wrong);
    tss__n_held *h = &s->held[0];
    size_t d = (size_t)s->dim;
    int same = count == h->count;
    for (int k = 0; same && k < count; k++) same = node[k] == h->node[k];
    if (count) memcpy(h->x, x, (size_t)count * d * sizeof(double));
    if (same) return TSS_OK;
    s->known = 0;
    for (int k = 0; k < h->count; k++) h->at[h->node[k]] = 0;
    memcpy(s->G_free, s->G, s->m * s->m * sizeof(double));
    for (int k = 0; k < count; k++) {
        h->node[k] = node[k], h->at[node[k]] = k + 1;
        for (size_t a = 0; a < d; a++) {
            size_t i = (size_t)node[k] * d + a;
            tss__reduced_rank_one(s, -s->mass[i], i, s->G_free);
        }
    }
    h->count = count;
    s->all_held = tss__reduced_trace(s, s->G_free) <= 1e-12 * tss__reduced_trace(s, s->G);
    return TSS_OK;
}

const double *tss_reduced_z(const tss_reduced *s) { return s->z; }
const uint64_t *tss_reduced_exits(const tss_reduced *s) { return s->exits; }

const double *tss_reduced_x(const tss_reduced *s) {
    if (*s->decoded) return s->x;
    const tss__n_held *h = &s->held[1];
    size_t wide = (size_t)s->dim;
    for (size_t i = 0; i < s->n; i++) s->x[i] = tss__reduced_at(s, i, s->phi);
    for (int k = 0; k < h->count; k++)
        memcpy(s->x + (size_t)h->node[k] * wide, h->x + (size_t)k * wide, wide * sizeof(double));
    *s->decoded = 1;
    return s->x;
}

// Coordinate a of a node in a past state.
static double tss__held_x(const tss_reduced *s, const tss__n_held *h, const double *phi, int node,
                          int a) {
    size_t i = (size_t)(node * s->dim + a);
    int at = h->at[node];
    return at ? h->x[(size_t)(at - 1) * (size_t)s->dim + (size_t)a] : tss__reduced_at(s, i, phi);
}

// What one node that was, or is, held does to the quadratic and the forces.
static void tss__reduced_odd_node(tss_reduced *s, int node) {
    for (int a = 0; a < s->dim; a++) {
        size_t i = (size_t)(node * s->dim + a);
        const double *b = s->B + i * s->m;
        double q = 2 * tss__held_x(s, &s->held[1], s->phi, node, a) -
                   tss__held_x(s, &s->held[2], s->phi_last, node, a);
        int at = s->held[0].at[node];
        if (at) {
            double x = s->held[0].x[(size_t)(at - 1) * (size_t)s->dim + (size_t)a];
            s->constant += s->mass[i] * (x - q) * (x - q);
            s->offset -= s->force[i] * (x - s->c[i]);
            tss__n_axpy(s->m, -s->force[i], b, s->u);
        } else {
            double off = q - tss__reduced_at(s, i, s->phi_bar);
            s->constant += s->mass[i] * off * off;
            tss__n_axpy(s->m, s->mass[i] * off, b, s->w);
        }
    }
}

// Sets up E of the step to come.
static void tss__reduced_prepare(tss_reduced *s) {
    s->fit = 0, s->half = s->def.h > 0 ? 0.5 / (s->def.h * s->def.h) : 0, s->quad = s->G_free;
    s->constant = 0, s->offset = -s->force_c;
    for (size_t a = 0; a < s->m; a++) s->phi_bar[a] = 2 * s->phi[a] - s->phi_last[a];
    memcpy(s->u, s->force_phi, s->m * sizeof(double));
    tss__n_zero(s->w, s->m);
    const tss__n_held *h = s->held;
    for (int k = 0; k < h[0].count; k++) tss__reduced_odd_node(s, h[0].node[k]);
    for (int k = 0; k < h[1].count; k++)
        if (!h[0].at[h[1].node[k]]) tss__reduced_odd_node(s, h[1].node[k]);
    for (int k = 0; k < h[2].count; k++)
        if (!h[0].at[h[2].node[k]] && !h[1].at[h[2].node[k]])
            tss__reduced_odd_node(s, h[2].node[k]);
}

// ---- directions -----------------------------------------------------------------------------

// d = −H g by the two loops over the history (Nocedal and Wright, algorithm 7.4).
static void tss__reduced_lbfgs(tss_reduced *s) {
    int r = s->r, M = s->def.memory;
    for (int i = 0; i < r; i++) s->d[i] = -s->g[i];
    for (int k = 0; k < s->pairs; k++) {
        int at = (s->newest + M - k) % M;
        s->part[at] = tss__dot_n(r, s->S + at * r, s->d) / s->curve[at];
        for (int i = 0; i < r; i++) s->d[i] -= s->part[at] * s->Y[at * r + i];
    }
    double scale = 1, size = sqrt(tss__dot_n(r, s->g, s->g));
    if (s->pairs) {
        const double *y = s->Y + s->newest * r;
        scale = s->curve[s->newest] / tss__dot_n(r, y, y);
    } else if (size > 1) {
        scale = 1 / size;  // the first step moves by 1 at most
    }
    for (int i = 0; i < r; i++) s->d[i] *= scale;
    for (int k = s->pairs - 1; k >= 0; k--) {
        int at = (s->newest + M - k) % M;
        double b = tss__dot_n(r, s->Y + at * r, s->d) / s->curve[at];
        for (int i = 0; i < r; i++) s->d[i] += (s->part[at] - b) * s->S[at * r + i];
    }
}

// One rotation of Jacobi's method: A(p, q) to 0, V's rows p and q turn along.
static void tss__eigen_turn(size_t r, double *A, double *V, size_t p, size_t q) {
    double apq = A[p * r + q];
    if (fabs(apq) <= 1e-16 * sqrt(fabs(A[p * r + p] * A[q * r + q])) || apq == 0) {
        return;
    }
    double tau = (A[q * r + q] - A[p * r + p]) / (2 * apq);
    double t = (tau >= 0 ? 1 : -1) / (fabs(tau) + sqrt(1 + tau * tau));
    double c = 1 / sqrt(1 + t * t), n = t * c;
    for (size_t i = 0; i < r; i++) {
        double x = A[i * r + p], y = A[i * r + q];
        A[i * r + p] = c * x - n * y, A[i * r + q] = n * x + c * y;
    }
    for (size_t i = 0; i < r; i++) {
        double x = A[p * r + i], y = A[q * r + i];
        A[p * r + i] = c * x - n * y, A[q * r + i] = n * x + c * y;
        x = V[p * r + i], y = V[q * r + i];
        V[p * r + i] = c * x - n * y, V[q * r + i] = n * x + c * y;
    }
}

// A = Σ λ_i v_i v_iᵀ by cyclic Jacobi rotations; v_i are the rows of V, A is overwritten. Converges
// quadratically; 30 sweeps are never needed.
static void tss__eigen(int r_, double *A, double *V, double *lambda) {
    size_t r = (size_t)r_;
    tss__n_identity(V, r_);
    for (int sweep = 0; sweep < 30; sweep++) {
        double off = 0, all = 0;
        for (size_t p = 0; p < r; p++)
            for (size_t q = 0; q < r; q++) {
                double a = A[p * r + q] * A[p * r + q];
                all += a, off += p == q ? 0 : a;
            }
        if (!(off > 1e-30 * all)) break;
        for (size_t p = 0; p + 1 < r; p++)
            for (size_t q = p + 1; q < r; q++) tss__eigen_turn(r, A, V, p, q);
    }
    for (size_t p = 0; p < r; p++) lambda[p] = A[p * r + p];
}

// The eigenvectors (rows of V) and eigenvalues of ∇²E at z; H is overwritten.
static void tss__reduced_hessian(tss_reduced *s) {
    int r = s->r;
    tss__reduced_energy(s, s->z, s->g_new, s->H);
    for (int a = 0; a < r; a++)
        for (int b = 0; b < a; b++)
            s->H[a * r + b] = s->H[b * r + a] = 0.5 * (s->H[a * r + b] + s->H[b * r + a]);
    tss__eigen(r, s->H, s->V, s->lambda);
}

// d = −(H₊ + shift)⁻¹ g, H₊ without negative eigenvalues. In a fit the shift is relative.
static void tss__reduced_newton(tss_reduced *s) {
    int r = s->r;
    double most = 0, shift = s->def.shift;
    tss__reduced_hessian(s);
    for (int a = 0; a < r; a++) most = s->lambda[a] > most ? s->lambda[a] : most;
    if (s->fit) shift = 1e-12 * most + 1e-300;
    tss__n_zero(s->d, (size_t)r);
    for (int a = 0; a < r; a++) {
        const double *v = s->V + a * r;
        double l = (s->lambda[a] > 0 ? s->lambda[a] : 0) + shift;
        tss__n_axpy((size_t)r, -tss__dot_n(r, v, s->g) / l, v, s->d);
    }
}

// The next direction. Returns its slope, negative unless there is none.
static double tss__reduced_direction(tss_reduced *s) {
    int newton = s->fit ? s->k_most > 0 : s->def.solver == TSS_PROJECTED_NEWTON;
    if (newton)
        tss__reduced_newton(s);
    else
        tss__reduced_lbfgs(s);
    double slope = tss__dot_n(s->r, s->g, s->d);
    if (slope < 0 || newton) return slope;
    s->pairs = 0;
    tss__reduced_lbfgs(s);
    return tss__dot_n(s->r, s->g, s->d);
}

// Keeps the pair of the step z → z_new if its curvature is safely positive.
static void tss__reduced_learn(tss_reduced *s) {
    int r = s->r, M = s->def.memory, at = (s->newest + 1) % M;
    double *S = s->S + at * r, *Y = s->Y + at * r;
    // Written over the oldest: that one is given up even if the new one is not kept.
    if (s->pairs == M) s->pairs--;
    for (int i = 0; i < r; i++) S[i] = s->z_new[i] - s->z[i], Y[i] = s->g_new[i] - s->g[i];
    double sy = tss__dot_n(r, S, Y), ss = tss__dot_n(r, S, S), yy = tss__dot_n(r, Y, Y);
    if (!(sy > 1e-12 * sqrt(ss) * sqrt(yy))) return;
    s->curve[at] = sy, s->newest = at, s->pairs++;
}

// Whether z_new = z + t d is: c1 = 1e-4. Where E itself is rounding, the slope decides (Hager and
// Zhang's approximate condition, the same on a parabola).
static int tss__reduced_better(const tss_reduced *s, double t, double slope, double E) {
    if (!isfinite(E)) return 0;
    return E <= s->energy + 1e-4 * t * slope ||
           (E <= s->energy + 1e-13 * fabs(s->energy) &&
            fabs(tss__dot_n(s->r, s->g_new, s->d)) <= -(1 - 2e-4) * slope);
}

static void tss__reduced_take(tss_reduced *s, double E) {
    size_t wide = (size_t)s->r * sizeof(double);
    memcpy(s->z, s->z_new, wide), memcpy(s->g, s->g_new, wide);
    s->energy = E;
}

// Backtracking along d by 0.8, as the paper's code. 1: z_new, g_new, *E are better.
static int tss__reduced_line(tss_reduced *s, double slope, double *E) {
    double t = 1;
    for (int k = 0; k < s->def.max_line; k++, t *= 0.8) {
        for (int i = 0; i < s->r; i++) s->z_new[i] = s->z[i] + t * s->d[i];
        *E = tss__reduced_energy(s, s->z_new, s->g_new, NULL);
        if (tss__reduced_better(s, t, slope, *E)) return 1;
    }
    return 0;
}

static double tss__n_largest(const double *g, int r) {
    double m = 0;
    for (int i = 0; i < r; i++) m = fabs(g[i]) > m || isnan(g[i]) ? fabs(g[i]) : m;
    return m;
}

static tss_exit tss__reduced_minimise(tss_reduced *s, int *iterations) {
    s->pairs = 0, s->newest = 0;
    for (*iterations = 0;; ++*iterations) {
        double E, eps = s->fit ? 0 : s->def.eps;
        if (tss__n_largest(s->g, s->r) <= eps) return TSS_EXIT_CONVERGED;
        if (*iterations == s->def.max_iterations) return TSS_EXIT_ITERATIONS;
        double slope = tss__reduced_direction(s);
        // −slope is the squared length in ‖·‖_M by which f would move.
        if (s->fit && -slope <= 1e-20 * s->scale) return TSS_EXIT_CONVERGED;
        if (!tss__reduced_line(s, slope, &E)) return TSS_EXIT_LINE_SEARCH;
        double fall = s->energy - E;
        tss__reduced_learn(s);
        tss__reduced_take(s, E);
        if (tss__n_largest(s->g, s->r) <= eps) continue;  // counted as converged
        if (!s->fit && s->def.ftol > 0 && fall < s->def.ftol * fabs(E)) {
            ++*iterations;  // this one
            return TSS_EXIT_SADDLE;
        }
    }
}

// ---- BFGS -----------------------------------------------------------------------------------

// Of the body's size: a move that is large enough to tell a curvature from rounding, and small
// enough to be of the same place; and one that tells nothing.
#define TSS__BFGS_PROBE 1e-6
#define TSS__BFGS_ROUNDING 1e-9
#define TSS__BFGS_LEAST 1e-14  // tol; below it E says nothing

// H begins as the inverse of |∇²E| (its eigenvalues' absolute values, none below 1e-8 of the
// largest).
static void tss__bfgs_begin(tss_reduced *s) {
    int r = s->r;
    double most = 0;
    tss__reduced_hessian(s);
    for (int a = 0; a < r; a++) most = fmax(most, fabs(s->lambda[a]));
    tss__n_zero(s->H, (size_t)r * (size_t)r);
    for (int a = 0; a < r; a++) {
        const double *v = s->V + a * r;
        double l = fmax(fabs(s->lambda[a]), most > 0 ? 1e-8 * most : 1);
        for (int i = 0; i < r; i++) tss__n_axpy((size_t)r, v[i] / l, v, s->H + i * r);
    }
    s->known = 1, s->touching_then = s->touching_at;
}

// H from the pair z → z_new (Nocedal and Wright, Eq. 6.17). 0: its curvature is not safely
// positive, H stays.
static int tss__bfgs_learn(tss_reduced *s) {
    int r = s->r;
    double *S = s->S, *Y = s->Y, *H = s->H, *u = s->V;
    for (int i = 0; i < r; i++) S[i] = s->z_new[i] - s->z[i], Y[i] = s->g_new[i] - s->g[i];
    double sy = tss__dot_n(r, S, Y), ss = tss__dot_n(r, S, S), yy = tss__dot_n(r, Y, Y);
    if (!(sy > 1e-12 * sqrt(ss) * sqrt(yy)) || !isfinite(yy)) return 0;
    for (int i = 0; i < r; i++) u[i] = tss__dot_n(r, H + i * r, Y);
    double f = (1 + tss__dot_n(r, u, Y) / sy) / sy;
    for (int i = 0; i < r; i++)
        for (int j = 0; j < r; j++)
            H[i * r + j] += f * S[i] * S[j] - (S[i] * u[j] + u[i] * S[j]) / sy;
    return 1;
}

// d = −H g. Returns its slope, negative unless there is none.
static double tss__bfgs_direction(tss_reduced *s) {
    int r = s->r;
    double slope = 0;
    for (int again = 0; again < 2 && !(slope < 0); again++) {
        if (!s->known || again) tss__bfgs_begin(s);
        for (int i = 0; i < r; i++) s->d[i] = -tss__dot_n(r, s->H + i * r, s->g);
        slope = tss__dot_n(r, s->g, s->d);
    }
    return slope;
}

// φ of z_new = z + t d, and to *move by how much of its size that moves the body.
static const double *tss__bfgs_go(tss_reduced *s, double t, double *move) {
    for (int i = 0; i < s->r; i++) s->z_new[i] = s->z[i] + t * s->d[i];
    const double *phi = tss__reduced_forward(s, s->z_new, 0);
    double square = 0;
    for (size_t a = 0; a < s->m; a++) s->gap[a] = phi[a] - s->phi_at[a];
    for (size_t a = 0; a < s->m; a++)
        square += s->gap[a] * tss__n_dot8(s->m, s->G_free + a * s->m, s->gap);
    *move = isnan(square) ? INFINITY : square > 0 ? sqrt(square) / s->size : 0;
    return phi;
}

// The t in [0.1 t, 0.8 t] where the cubic is least that has E0 and slope0 at 0, E and slope at t
// (Nocedal and Wright, Eq. 3.59).
static double tss__bfgs_shorter(double t, double E0, double slope0, double E, double slope) {
    double a = slope0 + slope - 3 * (E - E0) / t, b = a * a - slope0 * slope, best = 0.5 * t;
    if (isfinite(E) && b >= 0 && slope > 0)
        best = t - t * (slope + sqrt(b) - a) / (slope - slope0 + 2 * sqrt(b));
    else if (isfinite(E))
        best = -0.5 * slope0 * t * t / (E - E0 - slope0 * t);
    return best > 0.1 * t ? (best < 0.8 * t ? best : 0.8 * t) : 0.1 * t;
}

// The last evaluation was at what is the iterate now.
static void tss__bfgs_mark(tss_reduced *s) {
    s->touching_at = s->touching;
    memcpy(s->phi_at, tss__reduced_layer(s, s->tape, s->top), s->m * sizeof(double));
}

// H learns the curvature along d, which would move the body by `move`, from a longer move that is
// not made. 0: it is not positive.
static int tss__bfgs_measure(tss_reduced *s, double move) {
    const double *phi = tss__bfgs_go(s, TSS__BFGS_PROBE / move, &move);
    double E = tss__reduced_energy_there(s, phi, s->g_new, NULL);
    return isfinite(E) && tss__bfgs_learn(s);
}

// One iteration along d, which would move the body by `move`, φ there in phi. 0: no trial is
// better. *taught: whether H learned from it.
static int tss__bfgs_iterate(tss_reduced *s, const double *phi, double slope, double move,
                             int *taught) {
    double t = 1;
    for (int k = 0; k < s->def.max_line; k++) {
        if (k) phi = tss__bfgs_go(s, t, &move);
        double E = tss__reduced_energy_there(s, phi, s->g_new, NULL);
        if (tss__reduced_better(s, t, slope, E)) {
            *taught = move < TSS__BFGS_ROUNDING || tss__bfgs_learn(s);
            tss__reduced_take(s, E), tss__bfgs_mark(s);
            return 1;
        }
        t = tss__bfgs_shorter(t, s->energy, slope, E, tss__dot_n(s->r, s->g_new, s->d));
    }
    return 0;
}

// H may not know the place where it is: where a contact has opened it is as stiff as before, and
// all directions look small. So one small move does not end a step: it is made, H learns from it
// (or from a longer one that is only tried), and if the next is small too that ends the step. The
// exact Hessian has to say so too if H began in this step, and where no inertia bounds what is
// missed (h = 0) if other nodes touch than where it began. It also takes H's place, once, where H
// cannot learn or no trial is better.
static tss_exit tss__bfgs_minimise(tss_reduced *s, int *iterations) {
    double move, tol = fmax(s->def.tol, TSS__BFGS_LEAST);
    int quiet = 0, measured = 0, again = 1, began = !s->known;
    *iterations = 0;
    if (s->all_held) return TSS_EXIT_CONVERGED;
    for (;;) {
        if (tss__n_largest(s->g, s->r) == 0) return TSS_EXIT_CONVERGED;
        double slope = tss__bfgs_direction(s);
        if (!(slope < 0)) return TSS_EXIT_LINE_SEARCH;
        const double *phi = tss__bfgs_go(s, 1, &move);
        int still = move <= tol, taught, lost = 0;
        if (still && quiet) {
            int other = s->def.h == 0 && s->touching_at != s->touching_then;
            if (!began && !other) return TSS_EXIT_CONVERGED;
            began = s->known = 0;
            continue;
        }
        if (*iterations == s->def.max_iterations) return TSS_EXIT_ITERATIONS;
        if (still && !measured && move > 0 && move < TSS__BFGS_PROBE) {
            measured = 1, lost = !tss__bfgs_measure(s, move);
        } else if (tss__bfgs_iterate(s, phi, slope, move, &taught)) {
            quiet = measured = still, lost = still && !taught;
            ++*iterations;
        } else if (again) {
            lost = 1;
        } else {
            return still ? TSS_EXIT_CONVERGED : TSS_EXIT_LINE_SEARCH;
        }
        if (lost && again) again = s->known = quiet = 0;
    }
}

// ---- steps ----------------------------------------------------------------------------------

static tss_reduced_info tss__reduced_solve(tss_reduced *s) {
    tss_reduced_info info;
    memset(&info, 0, sizeof info);
    if (s->def.solver == TSS_BFGS && !s->fit)
        info.exit = tss__bfgs_minimise(s, &info.iterations);
    else
        info.exit = tss__reduced_minimise(s, &info.iterations);
    info.energy = s->energy, info.gradient = tss__n_largest(s->g, s->r);
    info.evaluations = s->evaluations, info.hessians = s->hessians;
    return info;
}

tss_result tss_reduced_step(tss_reduced *s, tss_reduced_info *out) {
    size_t wide = (size_t)s->r * sizeof(double);
    s->evaluations = s->hessians = 0;
    tss__reduced_prepare(s);
    for (int i = 0; i < s->r; i++) s->z_new[i] = 2 * s->z[i] - s->z_last[i];
    memcpy(s->z_last, s->z, wide);
    s->energy = tss__reduced_energy(s, s->z, s->g, NULL);
    tss__bfgs_mark(s);
    double E = tss__reduced_energy(s, s->z_new, s->g_new, NULL);
    if (isfinite(E) && !(E >= s->energy)) tss__reduced_take(s, E), tss__bfgs_mark(s);
    tss_reduced_info info = tss__reduced_solve(s);
    tss__reduced_advance(s);
    s->exits[info.exit]++;
    if (out) *out = info;
    return TSS_OK;
}

tss_result tss_reduced_project(tss_reduced *s, const double *x, tss_reduced_info *out) {
    for (size_t i = 0; i < s->n; i++)
        if (!isfinite(x[i]))
            return tss__n_refuse(&s->host, TSS_ERROR_BAD_ARGUMENT,
                                 "reduced solver: a position to project is not finite");
    // ½‖c + Bφ − x‖² about the φ that it starts from.
    s->evaluations = s->hessians = 0;
    s->fit = 1, s->half = 0.5, s->quad = s->G, s->constant = s->offset = 0;
    s->scale = tss__reduced_size(s, x);
    memcpy(s->phi_bar, tss__reduced_forward(s, s->z, 0), s->m * sizeof(double));
    tss__n_zero(s->u, s->m), tss__n_zero(s->w, s->m);
    for (size_t i = 0; i < s->n; i++) {
        double gap = x[i] - tss__reduced_at(s, i, s->phi_bar);
        s->constant += s->mass[i] * gap * gap;
        tss__n_axpy(s->m, s->mass[i] * gap, s->B + i * s->m, s->w);
    }
    s->energy = tss__reduced_energy(s, s->z, s->g, NULL);
    tss_reduced_info info = tss__reduced_solve(s);
    if (out) *out = info;
    return tss_reduced_set(s, s->z);
}

double tss_sdf_ball(void *ball, const double *x, double *n) {
    const tss_ball *b = (const tss_ball *)ball;
    double l = 0;
    for (int a = 0; a < b->dim; a++) n[a] = x[a] - b->center[a], l += n[a] * n[a];
    l = sqrt(l);
    for (int a = 0; a < b->dim; a++) n[a] = l > 0 ? n[a] / l : a == 0;  // in the centre: any
    return l - b->radius;
}

double tss_sdf_halfspace(void *halfspace, const double *x, double *n) {
    const tss_halfspace *h = (const tss_halfspace *)halfspace;
    double s = 0;
    for (int a = 0; a < h->dim; a++) n[a] = h->normal[a], s += n[a] * (x[a] - h->point[a]);
    return s;
}

// ---------------------------------------------------------------------------------------------
// >>decoder_basis (private)
// A reduced solver without elements finds z; with f = c + Bφ the Gram matrix of the tangent is
// ∂φᵀ G ∂φ: columns are made orthonormal in the r rows of ∂φ, before B.
// ---------------------------------------------------------------------------------------------

struct tss_decoder_basis {
    tss_host host;
    tss_reduced *s;
    const tss_net *encoder;
    tss_work *work;
    double *z;  // r: g(x)
};

void tss_decoder_basis_destroy(tss_decoder_basis *b) {
    if (!b) return;
    tss_host h = b->host;
    if (b->s) tss_free(&h, b->z, (size_t)b->s->r * sizeof(double));
    tss_reduced_destroy(b->s);
    tss_work_destroy(b->work);
    tss_free(&h, b, sizeof *b);
}

tss_result tss_decoder_basis_create(const tss_host *host, int dim, const tss_net *decoder,
                                    const tss_net *encoder, const double *mass, const double *z,
                                    tss_decoder_basis **out) {
    tss_host h = host ? *host : tss_host_default();
    tss_reduced_def d = tss_reduced_def_default();
    const char *wrong = NULL;
    *out = NULL;
    d.decoder = decoder, d.mass = mass, d.start = z, d.h = 0;
    if ((dim != 2 && dim != 3) || !decoder || decoder->has_in || decoder->outputs % dim)
        wrong = "decoder basis: the decoder does not give positions of nodes";
    else if (decoder->inputs > TSS__REDUCED_DENSE)
        wrong = "decoder basis: more than 1024 inputs";
    else if (encoder &&
             (encoder->inputs != decoder->outputs || encoder->outputs != decoder->inputs))
        wrong = "decoder basis: decoder and encoder do not fit each other";
    else
        wrong = tss__reduced_complaint(&d);
    if (wrong) return tss__n_refuse(&h, TSS_ERROR_BAD_ARGUMENT, wrong);
    tss_decoder_basis *b = (tss_decoder_basis *)tss_alloc(&h, sizeof *b);
    if (!b) return TSS_ERROR_NO_MEMORY;
    memset(b, 0, sizeof *b);
    b->host = h, b->encoder = encoder;
    tss_result r = tss__reduced_make(&h, &d, dim, &b->s);
    if (r == TSS_OK) {
        b->z = (double *)tss_alloc(&h, (size_t)b->s->r * sizeof(double));
        r = b->z ? tss_work_create(&h, &b->work) : TSS_ERROR_NO_MEMORY;
    }
    // The encoder's scratch is taken now.
    if (r == TSS_OK && encoder) r = tss_net_forward(encoder, b->work, 1, tss_reduced_x(b->s), b->z);
    if (r != TSS_OK) {
        tss_decoder_basis_destroy(b);
        return r;
    }
    *out = b;
    return TSS_OK;
}

static double tss__basis_product(tss_reduced *s, const double *u, const double *v) {  // uᵀ G v
    for (size_t i = 0; i < s->m; i++) s->gap[i] = tss__n_dot8(s->m, s->G + i * s->m, v);
    return tss__n_dot8(s->m, u, s->gap);
}

// The tangent's rows (derivatives of φ) made orthonormal in G, in their order, by Gram and Schmidt
// twice; what depends on those before to 0.
static void tss__basis_orthonormal(tss_reduced *s, double *rows) {
    size_t m = s->m;
    for (size_t a = 0; a < (size_t)s->r; a++) {
        double *v = rows + a * m, before = tss__basis_product(s, v, v);
        for (size_t b = 0; b < 2 * a; b++) {
            const double *u = rows + b % a * m;
            tss__n_axpy(m, -tss__basis_product(s, u, v), u, v);
        }
        double after = tss__basis_product(s, v, v),
               unit = after > 1e-20 * before ? 1 / sqrt(after) : 0;
        for (size_t i = 0; i < m; i++) v[i] *= unit;
    }
}

void tss_decoder_basis_refresh(void *user, const tss_ctx *c, int first_node, int nodes,
                               double *columns) {
    tss_decoder_basis *b = (tss_decoder_basis *)user;
    tss_reduced *s = b->s;
    size_t n = (size_t)nodes * (size_t)c->dim, r = (size_t)s->r, m = s->m;
    const double *x = c->x_t + (size_t)first_node * (size_t)c->dim;
    if (n != s->n || c->dim != s->dim) {
        tss_log(&b->host, TSS_LOG_ERROR, "decoder basis: %d nodes, the decoder has %d", nodes,
                s->nodes);
        tss__n_zero(columns, n * r);
        return;
    }
    if (b->encoder && tss_net_forward(b->encoder, b->work, 1, x, b->z) == TSS_OK)
        tss_reduced_set(s, b->z);
    tss_reduced_project(s, x, NULL);
    double *rows = tss__reduced_forward(s, s->z, s->r) + m;
    tss__basis_orthonormal(s, rows);
    for (size_t i = 0; i < n; i++)
        for (size_t a = 0; a < r; a++)
            columns[i * r + a] = tss__n_dot8(m, s->B + i * m, rows + a * m);
}

const double *tss_decoder_basis_z(const tss_decoder_basis *b) { return b->s->z; }
tss_result tss_decoder_basis_set(tss_decoder_basis *b, const double *z) {
    return tss_reduced_set(b->s, z);
}

#ifdef __cplusplus
}
#endif
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC pop_options
#endif
#endif  // TSS_IMPLEMENTATION

/*
MIT License

Copyright (c) 2026 The tss authors

Permission is hereby granted, free of charge, to any person obtaining a copy
of this software and associated documentation files (the "Software"), to deal
in the Software without restriction, including without limitation the rights
to use, copy, modify, merge, publish, distribute, sublicense, and/or sell
copies of the Software, and to permit persons to whom the Software is
furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all
copies or substantial portions of the Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR
IMPLIED, INCLUDING BUT NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY,
FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE
AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER
LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM,
OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE
SOFTWARE.
*/
