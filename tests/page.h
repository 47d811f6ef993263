// What the tests of pages share. Include after cmocka.h.
#ifndef PAGE_H
#define PAGE_H

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

// The whole file; free().
static inline char *slurp(const char *path) {
    FILE *f = fopen(path, "rb");
    assert_non_null(f);
    char *s = (char *)calloc(1, 1 << 22);
    assert_non_null(s);
    assert_true(fread(s, 1, (1 << 22) - 1, f) > 0);
    fclose(f);
    return s;
}

// Tags open and close in order, attributes are quoted, no stray < or &.
static inline void check_tags(const char *s) {
    char stack[64][16];
    int depth = 0, elements = 0;
    s = strstr(s, "<html");
    for (; *s; s++) {
        if (*s == '&')
            assert_true(strspn(s + 1, "#abcdefghijklmnopqrstuvwxyz0123456789") < 6 &&
                        strchr(s, ';') - s < 7);
        assert_true(*s != '>');
        if (*s != '<') continue;
        int closing = *++s == '/', n = 0;
        s += closing;
        char name[16] = {0};
        for (; (*s >= 'a' && *s <= 'z') || (*s >= '0' && *s <= '9'); s++)
            assert_true(n < 15), name[n++] = *s;
        assert_true(n > 0);
        for (int quoted = 0; *s && (quoted || *s != '>'); s++) {
            if (*s == '"') quoted = !quoted;
            assert_true(*s != '<' && (quoted || *s != '\''));
        }
        elements++;
        if (closing) {
            assert_true(depth > 0);
            assert_string_equal(stack[--depth], name);
        } else if (s[-1] != '/' && strcmp(name, "meta") && strcmp(name, "img") &&
                   strcmp(name, "input")) {
            assert_true(depth < 64);
            strcpy(stack[depth++], name);
        }
        if (!closing && !strcmp(name, "style")) s = strstr(s, "</style>") - 1;
    }
    assert_int_equal(depth, 0);
    assert_true(elements > 20);
}

#endif
