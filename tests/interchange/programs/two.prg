MODULE Two
    LOCAL CONST robtarget pA := [[650,50,450],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
    LOCAL CONST robtarget pB := [[650,-50,450],[0,0,1,0],[-1,0,-1,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
    VAR robtarget pCounted := [[600,0,450],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
    PROC Path_10()
        MoveL pA,v200,fine,tool0\WObj:=wobj0;
        MoveL pA,v200,fine,tOther\WObj:=wobj0;
        MoveJ \Conc, pB, v200, fine, tool0;
        pCounted.trans.x := pCounted.trans.x + 10;
        MoveL pCounted,v200,fine,tool0;
    ENDPROC
ENDMODULE
