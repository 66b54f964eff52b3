/* The cell-local fields of one cell after another, by Newton's method; this comes after `point.c`. */
#if NL + NC
/* Moves local fields to where the energy is stationary in them, the others held, by Newton's method in at
   most `most` iterations, going half of a step back where there is no next one; returns in how many cells that has
   failed. */
int relax(const Part *part, int most) {
  double U[NE + 1], y[NY + DATA + MULTIPLIERS + 1], kept[KEPT + 1];
  int failed = 0;
  for (int n = 0; n < part->cells; n++) {
    int cell = part->numbers[n], done = 0;
    double last[POINTS][NL + 1], change[NC + 1];
    gather(part, cell, part->values, U);
    for (int iteration = 0; !done && iteration < most; iteration++) {
      double fall = 0, size = 0; /* of the energy along the step, and along the unknowns themselves */
      double steps[POINTS][NL + 1], sign = -1;
      int bad = 0;
#if NC
      double C[NC*NC] = {0}, r[NC] = {0}, x[NC], scale[NC], work[NC], B[POINTS][NL + 1][NC];
      int order[NC];
#endif
      for (int q = 0; q < POINTS; q++) {
        long at = (long)n*POINTS + q;
        const double *geometry = part->geometry + at*(DIM*DIM + 1), w = geometry[DIM*DIM];
        double g[NY] = {0}, H[NY*NY+COLUMNS] = {0}, A[NA][COLUMNS], solution[NL + 1][COLUMNS] = {{0}};
        point(part, U, cell, at, q, y);
        functions(y, part->constants, kept);
        GRADIENT(g, y, part->constants);
        pull_back_functions(g, y, part->constants, kept);
        for (int i = 0; i < NR; i++) kept[NR+i] = g[NZ+i];
        HESSIAN(H, y, part->constants);
        chain_functions(H, y, part->constants, kept);
        for (int i = 0; i < NL; i++) solution[i][NA] = g[NA+i];
        if ((bad = eliminate(H, solution, A) != 0)) break;
        for (int i = 0; i < NL; i++) {
          steps[q][i] = solution[i][NA];
          fall += w*fabs(g[NA+i]*steps[q][i]); size += w*fabs(g[NA+i]*y[NA+i]); }
#if NC
        double AB[NA][NC] = {{0}};
#define X(f, bs, nodes, first, value, gradient, place) if (first >= NS) { \
        PHI(f, bs, nodes, first, value, gradient, place) \
        for (int p = 0; p < NA; p++) distribute(bs, nodes, value, gradient, phi##f, 1, A[p], AB[p] + first - NS); \
        for (int i = 0; i < NL; i++) { \
          for (int e = 0; e < bs*nodes; e++) B[q][i][first-NS+e] = 0; \
          distribute(bs, nodes, value, gradient, phi##f, 1, solution[i], B[q][i] + first - NS); } }
        EACH_ARGUMENT(X)
#undef X
#define X(f, bs, nodes, first, value, gradient, place) if (first >= NS) { \
        PHI(f, bs, nodes, first, value, gradient, place) \
        for (int i = 0; i < bs; i++) for (int a = 0; a < nodes; a++) { \
          int e = first - NS + i*nodes + a; \
          if (value >= 0) { r[e] += w*phi##f[0][a]*(g[value+i] + A[value+i][NA]); \
            for (int c = 0; c < NC; c++) C[e*NC+c] += w*phi##f[0][a]*AB[value+i][c]; } \
          if (gradient >= 0) for (int k = 0; k < DIM; k++) { \
            r[e] += w*phi##f[1+k][a]*(g[gradient+i*DIM+k] + A[gradient+i*DIM+k][NA]); \
            for (int c = 0; c < NC; c++) C[e*NC+c] += w*phi##f[1+k][a]*AB[gradient+i*DIM+k][c]; } } }
        EACH_ARGUMENT(X)
#undef X
#endif
      }
#if NC
      memcpy(x, r, sizeof r);
      bad = bad || solve(NC, 1, C, NC, x, 1, scale, order, work);
      if (!bad) for (int c = 0; c < NC; c++) {
        fall += fabs(r[c]*x[c]); size += fabs(r[c]*U[NS+c]);
        for (int q = 0; q < POINTS; q++) for (int i = 0; i < NL; i++) steps[q][i] -= B[q][i][c]*x[c]; }
#endif
      if (bad || !isfinite(fall)) {
        if (!iteration) break;
        sign = 1;
        for (int q = 0; q < POINTS; q++) for (int i = 0; i < NL; i++) steps[q][i] = last[q][i]/2;
      }
      memcpy(last, steps, sizeof steps);
#if NC
      for (int c = 0; c < NC; c++) change[c] = sign > 0 ? change[c]/2 : x[c];
#define X(f, bs, nodes, first, value, gradient, place) if (first >= NS) \
      for (int a = 0; a < nodes; a++) for (int i = 0; i < bs; i++) { \
        U[first+i*nodes+a] += sign*change[first-NS+i*nodes+a]; \
        part->values[f][bs*(long)part->dofs[f][nodes*(long)cell+a]+i] = U[first+i*nodes+a]; }
      EACH_ARGUMENT(X)
#undef X
#endif
      for (int q = 0; q < POINTS; q++) {
#define X(f, size, place) for (int k = 0; k < size; k++) \
          LOCAL(part->values, f, size, cell, q, k) += sign*last[q][place-NA+k];
        EACH_LOCAL(X)
#undef X
      }
      done = sign < 0 && fall <= 1e-8*size; /* of a relative change that Newton's method squares */
    }
    failed += !done; }
  return failed;
}
#else
int relax(const Part *part, int most) { return 0; }
#endif
